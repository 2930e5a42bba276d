# From an empty folder and an environment that has the wheel alone (torchrl-osr[train]) to
# a policy without simulator: sh from_the_wheel.sh [updates], in an empty folder.
set -eux
steps=${1:-3000}
torchrl-osr collect env.id=Pendulum-v1 path=pendulum.npz progress=false
torchrl-osr data data.path=pendulum.npz env.id=Pendulum-v1 progress=false
torchrl-osr train env.id=Pendulum-v1 data=file data.path=pendulum.npz trainer.steps="$steps" trainer.inverse_dynamics_steps=$((steps / 3)) trainer.eval_interval=$((steps / 2)) trainer.log_interval=$((steps / 4)) trainer.progress=false hydra.run.dir=run
torchrl-osr evaluate checkpoint=run suite=action last=1 episodes=4 progress=false
torchrl-osr report run
torchrl-osr export run pendulum.safetensors
python -I -c "
import numpy, torchrl_osr
policy = torchrl_osr.load_policy('pendulum.safetensors')
print(policy.act(numpy.array([1.0, 0.0, 0.0])), policy.value(numpy.array([1.0, 0.0, 0.0])))"
