from ibrobot_eval.evaluation import differences
from ibrobot_eval.policies import Policy, hash_of_files, labelled


def policy(config, mode, model):
    return Policy("", config, mode, model, ())


def labels(*policies):
    return [each.label for each in labelled(policies)]


def test_label_has_the_mode_unless_something_else_tells_policies_apart():
    assert labels(policy("a.yaml", "act", "m")) == ["act"]
    assert labels(policy("a.yaml", "act", "m"), policy("a.yaml", "diffusion", "n")) == ["act", "diffusion"]
    assert labels(policy("x/a.yaml", "act", "m"), policy("b.yaml", "act", "m")) == ["a", "b"]
    assert labels(policy("a.yaml", "act", "m"), policy("a.yaml", "act", "n")) == ["m", "n"]


def test_labels_of_all_combinations_are_short_and_unique():
    found = labels(*(policy(config, mode, "m") for config in ("a.yaml", "b.yaml") for mode in ("act", "pi")))
    assert found == ["act a", "pi a", "act b", "pi b"]
    assert labels(policy("x/a.yaml", "act", "m"), policy("y/a.yaml", "act", "m")) == ["act a m", "act a m 2"]


def test_names_of_folders_are_safe_and_unique():
    found = labelled([policy("a.yaml", "run/1", "m"), policy("a.yaml", "run:1", "m")])
    assert [each.folder for each in found] == ["run_1", "run_1_2"]


def test_hash_changes_with_any_file_of_a_checkpoint(tmp_path):
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner/model.safetensors").write_bytes(b"weights")
    before = hash_of_files([tmp_path])
    assert before == hash_of_files([tmp_path])
    (tmp_path / "inner/model.safetensors").write_bytes(b"WEIGHTS")
    changed = hash_of_files([tmp_path])
    (tmp_path / "inner/model.safetensors").rename(tmp_path / "model.safetensors")
    assert len({before, changed, hash_of_files([tmp_path])}) == 3
    assert hash_of_files([tmp_path / "missing"]) == ""


def test_differences_of_settings_are_named():
    known = {"seed": 0, "policies": {"act": {"document": "1", "files": "2"}, "pi": {}}, "versions": {"a": "1"}}
    now = {"seed": 5, "policies": {"act": {"document": "1", "files": "3"}}, "versions": {"a": "2"}}
    assert list(differences(known, now)) == [
        "seed 0, now 5", "policies act files changed", "policies pi is missing", "versions a 1, now 2",
    ]  # fmt: skip


def test_command_repeats_an_episode_with_all_overrides():
    made = Policy("act", "my robot.yaml", "act", "m", ("simulation.scene={type: stack}",))
    assert made.command(7) == (
        "ibrobot record 'my robot.yaml' --sim --lockstep --headless --mode act --seed 7 --episodes 1 "
        "--set 'simulation.scene={type: stack}'"
    )
