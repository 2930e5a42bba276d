"""Search ways back from the hard states, with the simulator itself as the model.

    python results/recovery/search.py walker2d
    python results/recovery/search.py walker2d --deeper 30
    python results/recovery/search.py walker2d --ways 128 150

Cross-entropy method over offsets on the expert's actions, held for four steps each;
afterwards the expert acts alone. What is saved by the first stage is recoverable; a
line for each state is appended to ``parts/<system>/search-0.jsonl``. What more would
save is asked of a sample of the rest, in ``parts/<system>/curve.jsonl``: each stage
tries what the earlier ones did not save, with about three times their rollouts. Ways
for training, from files of ``states.py --ways``, are searched by the first stage, too.
Interrupted, it goes on where it was.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from states import PARTS, generator, hard, normal
from world import Policy, Rows, World

from torchrl_osr._files import read_arrays

HOLD = 4
"""Steps for which an offset is held."""

TAIL = 60
"""Steps of the expert after the last offset that count in the search.

Until a candidate that gets so far fails later: from then on all steps count.
"""

CHANGES = (1e-3,) * 4 + (1e-2,) * 4
"""A witness also succeeds after these changes, in standard deviations."""

TRIED_CHANGE = 5e-3
"""Of the candidates' starts, so that a way needs to be no needle's eye."""

ELITE = 0.125

SPREAD = {"halfcheetah": 1.0}
"""First standard deviation of the offsets; elsewhere 0.5. It has to roll over."""


@dataclass(frozen=True)
class Stage:
    """Size of one search."""

    candidates: int
    iterations: int
    knots: int


STAGES = (
    Stage(48, 4, 10),  # 192 rollouts
    Stage(96, 4, 15),  # 384
    Stage(144, 8, 15),  # 1152
    Stage(288, 12, 25),  # 3456
    Stage(512, 20, 25),  # 10240
)


class Planner:
    """Searches for witnesses in one world."""

    def __init__(self, world: World, std: Rows) -> None:
        self.world, self.std = world, std
        self.expert: Policy = world.policy("expert")
        self.rollouts = self.steps = 0

    def holds(self, row: Rows, knots: np.ndarray, rng: np.random.Generator) -> bool:
        """Whether offsets succeed from the state and after each of eight changes."""
        rows = np.repeat(row[None], 1 + len(CHANGES), axis=0)
        scale = np.array((0.0, *CHANGES))[:, None] * self.std
        rows = self.world.changed(rows, scale, rng)
        offsets = np.repeat(knots, HOLD, axis=0)[None].repeat(len(rows), axis=0)
        # First from the state itself: most ways that are none fail there.
        for some in (slice(0, 1), slice(1, None)):
            played = self.world.play(
                rows[some], self.expert, self.world.steps, offsets[some]
            )
            self.rollouts += len(played.alive)
            self.steps += played.steps
            if not played.success.all():
                return False
        return True

    def score(
        self, row: Rows, knots: np.ndarray, steps: int, rng: np.random.Generator
    ) -> Rows:
        """Score of candidates ``[B, K, A]``, each from a start a little changed.

        Steps alive; less the steps to the goal; HalfCheetah's speed, and more if its
        back is up, without which a search from its back has nothing to go by.
        """
        rows = np.repeat(row[None], len(knots), axis=0)
        rows = self.world.changed(rows, TRIED_CHANGE * self.std, rng)
        offsets = np.repeat(knots, HOLD, axis=1)
        falls = self.world.system in ("hopper", "walker2d")
        first = min(steps, offsets.shape[1] + TAIL) if falls else steps
        played = self.world.play(rows, self.expert, first, offsets)
        self.rollouts += len(rows)
        self.steps += played.steps
        if self.world.is_maze:
            return -played.alive.astype(float)
        if self.world.system == "halfcheetah":
            return played.speed + self.world.least_speed * np.cos(played.rows[:, 3])
        score = played.alive.astype(float)
        # Twice the elite is enough to go on with.
        up = np.flatnonzero(played.success)[: int(2 * ELITE * len(knots))]
        if steps > first and len(up):
            later = self.world.play(played.rows[up], self.expert, steps - first)
            self.steps += later.steps
            score[up] += later.alive
        return score

    def promising(self, score: Rows, steps: int) -> np.ndarray:
        """Candidates worth a full check, the best three at most."""
        enough: float = steps
        if self.world.is_maze:
            enough = 0.5 - self.world.steps
        if self.world.system == "halfcheetah":  # on its feet, and fast enough
            enough = 1.5 * self.world.least_speed
        order = np.argsort(-score, kind="stable")[:3]
        return order[score[order] >= enough]

    def search(
        self, row: Rows, stage: Stage, warm: np.ndarray | None, rng
    ) -> tuple[np.ndarray, bool]:
        """Offsets ``[K, A]``, and whether they are a witness.

        Args:
            row: the state, ``[N]``.
            stage: how much is tried.
            warm: the best offsets so far, which are among the first candidates.
            rng: of the candidates.
        """
        shape = stage.knots, self.world.nu
        nothing = np.zeros(shape, np.float32)
        if self.holds(row, nothing, rng):  # the maze's controller, most of the time
            return nothing, True
        mean = np.zeros(shape)
        spread = np.full(shape, SPREAD.get(self.world.system, 0.5))
        best, best_score = mean, -np.inf
        steps = self.world.steps if self.world.is_maze else stage.knots * HOLD + TAIL
        for _ in range(stage.iterations):
            noise = rng.standard_normal((stage.candidates, *shape))
            knots = np.clip(mean + spread * noise, -2, 2)
            knots[0] = mean
            if warm is not None:
                knots[1] = 0
                knots[1, : len(warm)] = warm
                warm = None
            # As they are stored: what is checked is what is kept.
            knots = np.round(knots, 4).astype(np.float32)
            score = self.score(row, knots, steps, rng)
            promising = self.promising(score, steps)
            for number in promising:
                if self.holds(row, knots[number], rng):
                    return knots[number], True
            elite = np.argsort(-score, kind="stable")
            elite = elite[: int(ELITE * stage.candidates)]
            if score[elite[0]] > best_score:
                best, best_score = knots[elite[0]], score[elite[0]]
            mean = knots[elite].mean(0)
            spread = np.maximum(0.1 * spread + 0.9 * knots[elite].std(0), 0.05)
            middle = np.round(mean, 4).astype(np.float32)
            if len(promising):
                if self.holds(row, middle, rng):
                    return middle, True
                if steps < self.world.steps:
                    steps, best_score = self.world.steps, -np.inf
        return np.asarray(best, dtype=np.float32), False


def read_jsonl(*paths: Path) -> list[dict]:
    """All lines of the files that there are, without those that were cut off."""
    lines = []
    for path in paths:
        for line in path.read_text().splitlines() if path.exists() else ():
            try:
                lines.append(json.loads(line))
            except json.JSONDecodeError:
                continue
    return lines


def read_lines(folder: Path) -> list[dict]:
    """All lines of the searches so far."""
    return read_jsonl(*sorted(folder.glob("search-*.jsonl")))


def hard_states(world: World, folder: Path) -> list[tuple[int, int, Rows]]:
    """Part, index and row of every hard state so far."""
    found = []
    for path in sorted(folder.glob("states-*.npz")):
        arrays = read_arrays(path)
        part = int(path.stem.removeprefix("states-"))
        for index in np.flatnonzero(hard(world.is_maze, arrays["jury"])):
            found.append((part, int(index), arrays["state"][index]))
    return found


def main() -> None:
    """Search what is not searched yet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("system")
    parser.add_argument(
        "--deeper", type=int, help="all later stages, for so many of what is not saved"
    )
    parser.add_argument("--ways", type=int, nargs=2, help="of these files")
    given = parser.parse_args()
    world = World(given.system)
    planner = Planner(world, normal(world)["std"])
    folder = PARTS / given.system / ("ways" if given.ways else "")
    first = {(x["part"], x["index"]): x for x in read_lines(folder) if not x["stage"]}
    states = hard_states(world, folder)
    path, stages = folder / "search-0.jsonl", range(1)
    if given.ways:
        states = [x for x in states if x[0] in range(*given.ways)]
        path = folder / f"search-{given.ways[0]}.jsonl"
    if given.deeper is not None:
        path, stages = folder / "curve.jsonl", range(1, len(STAGES))
        states = [x for x in states if x[:2] in first and not first[x[:2]]["saved"]]
        order = generator(given.system, 4).permutation(len(states))
        states = [states[number] for number in order[: given.deeper]]
    done = {(x["part"], x["index"], x["stage"]): x for x in read_jsonl(path)}
    done |= {(*key, 0): line for key, line in first.items()}
    with path.open("a") as file:
        if file.tell():
            file.write("\n")  # after a line that was cut off
        for part, index, row in states:
            for number in stages:
                earlier = done.get((part, index, number - 1))
                if (part, index, number) in done:
                    continue
                if earlier and earlier["saved"]:
                    break
                warm = np.array(earlier["offsets"]) if earlier else None
                rng = generator(given.system, part, index, number, 2)
                planner.rollouts = planner.steps = 0
                start = time.process_time()
                offsets, saved = planner.search(row, STAGES[number], warm, rng)
                line = {
                    "part": part,
                    "index": index,
                    "stage": number,
                    "saved": saved,
                    "rollouts": planner.rollouts,
                    "steps": planner.steps,
                    "seconds": round(time.process_time() - start, 2),
                    "offsets": np.round(offsets.astype(float), 4).tolist(),
                }
                done[part, index, number] = line
                file.write(json.dumps(line, separators=(",", ":")) + "\n")
                file.flush()


if __name__ == "__main__":
    main()
