#!/usr/bin/env bash
# Two tiny runs by each launcher that can be had on one machine, by the commands of
# docs/configuration.md. Needs: pip install "torchrl-osr[train,slurm,ray]".
#
#   bash results/launchers/run.sh /tmp/launchers
set -uo pipefail
mkdir -p "$1" && cd "$1" || exit 1
tiny="data=random data.num_transitions=600 data.held_out=0.1 network.num_cells=[8]
  trainer.batch_size=8 trainer.inverse_dynamics_steps=10 trainer.steps=20
  trainer.log_interval=10 trainer.eval_interval=10 trainer.eval_episodes=1
  trainer.checkpoint_interval=10"
sweep() {
  local folder=$1; shift
  echo "=== torchrl-osr train -m seed=0,1 $*"
  # shellcheck disable=SC2086
  torchrl-osr train -m seed=0,1 $tiny "$@" hydra.sweep.dir="$PWD/$folder"
  echo "exit code $?"
  for run in "$folder"/[0-9]*/status.json; do echo "$run: $(tr -d '\n' < "$run")"; done
}
sweep basic
sweep pool hydra/launcher=pool
sweep submitit hydra/launcher=submitit_local
sweep ray hydra/launcher=cluster hydra.launcher.ray.init.address=local
