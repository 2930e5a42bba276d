"""Episodes in which every state is another number."""

from __future__ import annotations

import torch
from hypothesis import strategies as st
from tensordict import TensorDict

LENGTHS = st.lists(st.integers(1, 6), min_size=1, max_size=6)
"""Lengths of episodes."""


def episodes(lengths) -> TensorDict:
    """Episodes that terminate or are cut off in turns, with random rewards.

    States are numbered from 1 on, and actions after them.
    """
    rows, at = [], 0
    for episode, length in enumerate(lengths):
        state = torch.arange(at, at + length + 1.0).unsqueeze(-1) + 1
        done = torch.arange(length).unsqueeze(-1) == length - 1
        terminated = done & (episode % 2 == 0)
        after = {"observation": state[1:], "reward": torch.randn(length, 1)}
        after |= {
            "done": done,
            "terminated": terminated,
            "truncated": done ^ terminated,
        }
        columns = {"observation": state[:-1], "action": 0.001 * state[:-1]}
        rows.append(TensorDict(columns | {"next": after}, [length]))
        at += length + 1
    return torch.cat(rows)
