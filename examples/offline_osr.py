"""Train a policy with OSR on real MuJoCo transitions, from nothing, with one command.

    python examples/offline_osr.py env=hopper

The same as ``torchrl-osr train env=hopper``; :mod:`torchrl_osr.lab.cli.train` is the
whole story: data, inverse dynamics model, policy, on TorchRL's trainer.
"""

import sys

from torchrl_osr.lab.__main__ import main

if __name__ == "__main__":
    main(["train", *sys.argv[1:]])
