"""Data that are rolled out on this machine: tasks, behaviour policies, their cache."""
