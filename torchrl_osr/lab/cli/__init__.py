"""The commands, one a file: ``torchrl-osr train`` is ``train.py``."""
