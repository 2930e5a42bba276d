#!/bin/sh
# The runs of this folder's README, in this folder: sh run.sh 2>&1 | tee output.txt
set -ex
short="trainer.inverse_dynamics_steps=1000 trainer.eval_interval=500"

torchrl-osr collect env.id=Pendulum-v1 path=pendulum.npz
torchrl-osr train env.id=Pendulum-v1 data=file data.path=pendulum.npz trainer.steps=3000 $short hydra.run.dir=outputs/pendulum
torchrl-osr evaluate checkpoint=outputs/pendulum last=1

torchrl-osr collect env.id=InvertedPendulum-v5 policy=controllers:balance noise=0.5 episodes=200 path=inverted_pendulum.npz
torchrl-osr train env.id=InvertedPendulum-v5 data=file data.path=inverted_pendulum.npz trainer.steps=2000 $short hydra.run.dir=outputs/inverted_pendulum
torchrl-osr evaluate checkpoint=outputs/inverted_pendulum last=1

torchrl-osr collect env.id=CartPole-v1 path=cartpole.npz episodes=500
torchrl-osr train env.id=CartPole-v1 loss=discrete_osr data=file data.path=cartpole.npz trainer.steps=2000 $short hydra.run.dir=outputs/cartpole
torchrl-osr evaluate checkpoint=outputs/cartpole last=1 suite=torque
