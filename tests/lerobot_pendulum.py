"""Episodes of a pendulum, and how LeRobot's own writer wrote them to a folder.

    pip install "lerobot[dataset]"
    python tests/lerobot_pendulum.py tests/lab/data/lerobot_pendulum

The committed folder was written by lerobot 0.4.4.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np

FPS = 20
LENGTHS = [9, 6, 9, 7, 9]
REACHED = [False, True, False, True, False]


def make_episodes() -> list[dict[str, Any]]:
    """Return a pendulum's episodes; one that reaches its goal stays for two rows."""
    rng = np.random.default_rng(0)
    episodes = []
    for length, reached in zip(LENGTHS, REACHED, strict=True):
        angle = np.pi * np.cos(np.arange(length) / 4 + rng.uniform(0, 6))
        states = [np.cos(angle), np.sin(angle), np.gradient(angle)]
        left = np.arange(length, 0, -1)
        episode = {
            "observation.state": np.stack(states, 1).astype(np.float32),
            "action": rng.uniform(-2, 2, (length, 1)).astype(np.float32),
            "next.reward": -np.abs(angle[:, None]).astype(np.float32),
            "next.done": left[:, None] == 1,
            "next.success": (left[:, None] <= 2) & reached,
        }
        episodes.append(episode)
    return episodes


def main(folder: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    vector = {"dtype": "float32", "shape": (3,), "names": ["cos", "sin", "speed"]}
    image = {"dtype": "image", "shape": (8, 8, 3), "names": ["height", "width", "rgb"]}
    features = {
        "observation.state": vector,
        "observation.images.top": image,
        "action": {"dtype": "float32", "shape": (1,), "names": {"motors": ["torque"]}},
        "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
        "next.done": {"dtype": "bool", "shape": (1,), "names": None},
        "next.success": {"dtype": "bool", "shape": (1,), "names": None},
    }
    options: Any = {"root": folder, "features": features, "use_videos": False}
    data = LeRobotDataset.create("local/pendulum", FPS, **options)
    for number, episode in enumerate(make_episodes()):
        # A small limit begins a file: the first holds three episodes, the second two.
        limit = 1e-6 if number == 3 else 100
        data.meta.update_chunk_settings(data_files_size_in_mb=limit)
        for row in range(len(episode["action"])):
            frame = {name: column[row] for name, column in episode.items()}
            frame["observation.images.top"] = np.zeros((8, 8, 3), np.uint8)
            data.add_frame(frame | {"task": "swing up"})
        data.save_episode()
    data.finalize()
    shutil.rmtree(folder / "images")
    shutil.rmtree(folder / "meta" / "episodes")  # large, and not read
    (folder / "meta" / "stats.json").unlink()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
