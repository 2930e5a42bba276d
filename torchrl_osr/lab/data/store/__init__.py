"""Transition data sets: what they are, where they are kept, how they are drawn from."""
