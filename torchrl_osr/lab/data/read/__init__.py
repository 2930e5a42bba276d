"""Recorded data: Minari, D4RL and files of your own, read as transitions."""
