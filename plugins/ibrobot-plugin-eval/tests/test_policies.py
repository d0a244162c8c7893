import pytest
from ibrobot_eval.evaluation import differences
from ibrobot_eval.policies import Policy, Variation, hash_of_files, labelled

from ibrobot_core.api import IbrobotError


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
        "seed 0, now 5",
        "policies act files changed",
        "policies pi is missing",
        "versions a 1, now 2",
    ]


def test_command_repeats_an_episode_with_all_overrides():
    made = Policy("act", "my robot.yaml", "act", "m", ("simulation.scene={type: stack}",))
    assert made.command(7) == (
        "ibrobot record 'my robot.yaml' --sim --lockstep --headless --mode act --seed 7 --episodes 1 "
        "--set 'simulation.scene={type: stack}'"
    )


def test_consecutive_seeds_have_all_combinations_of_what_varies():
    made = Policy("act", "a.yaml", "act", "m", ("x=1",), vary=("scene.light=0.2:1.5:3", "rate=1:2:2"))
    found = [tuple(made.varied(seed).values()) for seed in range(6)]
    assert found == [(0.2, 1.0), (0.85, 1.0), (1.5, 1.0), (0.2, 2.0), (0.85, 2.0), (1.5, 2.0)]
    assert made.varied(6) == made.varied(0)
    assert made.command(1).endswith("--set x=1 --set scene.light=0.85 --set rate=1.0")
    assert made.overrides_of(None) == ("x=1",)


@pytest.mark.parametrize("text", ["light", "light=1", "light=1:2", "light=2:1:5", "light=1:2:1", "=1:2:3", "a=0:inf:3"])
def test_other_variations_are_refused(text):
    with pytest.raises(IbrobotError, match="--vary"):
        Variation.of(text)
