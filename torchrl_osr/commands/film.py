"""Film a recovery: who survives a push, and which states do they visit?

    torchrl-osr film checkpoint=outputs/hopper-medium-replay/osr-seed0-...
    torchrl-osr film checkpoint=<run's folder> knock=5 rule=time
    torchrl-osr film checkpoint=<run's folder> push=1 film_seed=30004

Figure 3 of the paper: after a push, the behaviour policy, the inverse dynamics model as
a controller and the trained policy go on from the same state. Data of your own have no
behaviour policy that could play: the trained policy plays from the start. The run's
folder gets ``film.png``, ``film.gif``, ``visited.png`` and ``film.json``; the table
counts all episodes that survive. See ``docs/film.md``.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any

if sys.platform == "linux":  # before MuJoCo is imported; egl needs no display
    os.environ.setdefault("MUJOCO_GL", "egl")
try:
    import_module("mujoco")  # loads OpenGL, whose libraries fail in many ways
except ModuleNotFoundError:
    raise
except Exception as error:
    raise RuntimeError(
        f"OpenGL did not start with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')}: set "
        "it to egl (no display), osmesa (no graphics driver) or glfw (a display)."
    ) from error

import hydra
import torch
from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf
from torchrl import torchrl_logger

from torchrl_osr._checks import check_choice
from torchrl_osr._files import write_json
from torchrl_osr.commands import CONF
from torchrl_osr.commands.console import single_job
from torchrl_osr.data import (
    QUALITIES,
    load_behavior_policy,
    make_environment,
    sampled_observations,
)
from torchrl_osr.envs import ActionKnock, ExternalPush
from torchrl_osr.evaluation import DataDistance, Wrap, deterministic_policy
from torchrl_osr.experiment.build import load_data
from torchrl_osr.experiment.limits import check_values
from torchrl_osr.experiment.run_config import flatten
from torchrl_osr.experiment.trained_run import TrainedRun, load_trained
from torchrl_osr.film import (
    BEHAVIOR,
    Camera,
    Controller,
    InverseDynamicsController,
    Survival,
    Take,
    film_gif,
    film_strip,
    play_takeovers,
    survival_table,
    visited_states,
)

PUSH_STEPS = 5
STEPS_BEFORE = 10  # in the film
MODEL, RULES = "inverse dynamics, ", ("time", "nearest")


@dataclass
class FilmConfig:
    """All keys of ``torchrl-osr film``; what they mean is beside their values."""

    checkpoint: str = MISSING
    push: float = MISSING
    knock: int | None = None
    window: list[int] = MISSING
    after: int = MISSING
    rule: str = MISSING
    episodes: int = MISSING
    seed: int = MISSING
    film_seed: int | None = None
    num_threads: int = MISSING
    trust: list[str] = MISSING


ConfigStore.instance().store(name="film_schema", node=FilmConfig)


@hydra.main(version_base="1.3", config_path=f"{CONF}/evaluation", config_name="film")
@single_job
def main(cfg: DictConfig) -> None:
    """Play all episodes with every controller, print the table, film one of them."""
    check_values(flatten(OmegaConf.to_container(cfg, resolve=True)))
    torchrl_logger.setLevel("WARNING")
    torch.set_num_threads(cfg.num_threads)
    if cfg.knock is None and cfg.push <= 0:
        raise ValueError(f"push must be above 0 body weights, got {cfg.push}.")
    if cfg.film_seed is not None and not 0 <= cfg.film_seed - cfg.seed < cfg.episodes:
        raise ValueError(
            f"film_seed={cfg.film_seed} is none of the {cfg.episodes} episodes from "
            f"seed={cfg.seed} on."
        )
    event, duration, wrap = disturbance(cfg)
    trained = load_trained(cfg.checkpoint, trust=cfg.trust)
    run = trained.config
    camera = Camera(make_environment(run.env.id), 224)  # fails before the work
    data, _ = load_data(run, progress=False)
    (first, policy), *others = players(trained).items()
    played, ends = play_takeovers(
        run.env.id, policy([]), dict(others), wrap, name=first, duration=duration,
        latest=cfg.window[1], after=cfg.after, num_episodes=cfg.episodes, seed=cfg.seed,
    )  # fmt: skip

    # An episode that ends without the push says nothing about it.
    kept = played[first].up_clean(ends, cfg.after)
    if not kept:
        raise ValueError(
            f"In all {cfg.episodes} episodes the {first} falls, or the episode ends, "
            f"within {cfg.after} steps of the {event}, even without it: choose an "
            "earlier window or a smaller after."
        )
    measure = (kept, ends, DataDistance(data), (cfg.after // 2, cfg.after))
    results = {name: each.survival(*measure) for name, each in played.items()}
    hidden = {MODEL + rule for rule in RULES} - {MODEL + cfg.rule}
    filmed = [name for name in played if name not in hidden]
    episode, why = choose(cfg, kept, [results[name].up for name in filmed])
    end = int(ends[episode])
    takes = [
        Take.of(name, played[name].disturbed, episode, end - duration, end)
        for name in filmed
    ]
    title = f"{run.env.name} {run.data.quality}: {in_words(cfg, takes[0].force)}"
    one = f"one episode: seed {cfg.seed + episode}, {why}"
    draw(cfg, takes, camera, sampled_observations(data), trained, results, title, one)
    write_json(
        trained.folder / "film.json",
        {
            "gradient_step": trained.step,
            "options": OmegaConf.to_container(cfg),
            "filmed": {"seed": cfg.seed + episode, "why": why, f"{event}_over": end},
            "seeds": [cfg.seed + each for each in kept],
            "controllers": {name: vars(each) for name, each in results.items()},
        },
    )
    strength = cfg.push if cfg.knock is None else cfg.knock
    print(
        f"{run.env.name} {run.data.quality}, {event}={strength:g}, {len(kept)} episodes"
    )
    print(survival_table(results))
    if first != BEHAVIOR:
        print(
            f"  {run.data.quality} data have no behaviour policy to play first: the "
            f"{first} does"
        )
    print(f"  filmed: {one}\n  files:  {trained.folder}")


def draw(
    cfg: DictConfig,
    takes: list[Take],
    camera: Camera,
    states: torch.Tensor,
    trained: TrainedRun,
    results: dict[str, Survival],
    title: str,
    one: str,
) -> None:
    """Write the three pictures."""
    event, duration, _ = disturbance(cfg)
    first = takes[0].name
    total = len(results[first].alive)
    up = "; ".join(f"{take.name} {sum(results[take.name].up)}" for take in takes)
    note = (
        f"This is {one}. Until the {event} ends, the {first} plays in all "
        f"rows.\nOf {total} such episodes, up {cfg.after} steps later: {up}."
    )
    start, folder = -duration - STEPS_BEFORE, trained.folder
    later = [round(share * cfg.after) for share in (0.125, 0.25, 0.5, 0.75, 1)]
    columns, frames = [start, -duration, 0, *later], range(start, cfg.after + 1)
    options = {"title": title, "event": event}
    film_strip(
        takes, camera, folder / "film.png", offsets=columns, note=note, **options
    )
    film_gif(takes, camera, folder / "film.gif", offsets=frames, note=one, **options)
    camera.close()
    path, rows = folder / "visited.png", states.numpy()
    visited_states(rows, takes, path, note=one, steps=cfg.after, **options)


def disturbance(cfg: DictConfig) -> tuple[str, int, Wrap]:
    """Name of the disturbance, its duration in steps, and its wrapper."""
    check_choice("rule", cfg.rule, RULES)
    if len(cfg.window) != 2 or not STEPS_BEFORE <= cfg.window[0] < cfg.window[1]:
        raise ValueError(
            f"window must begin at {STEPS_BEFORE} or later and end later still, got "
            f"{cfg.window}."
        )
    moment: dict[str, Any] = {"at": "random", "window": tuple(cfg.window)}
    if cfg.knock is not None:
        knock = partial(ActionKnock, steps=cfg.knock, mode="torque", **moment)
        return "knock", cfg.knock, knock
    strength: dict[str, Any] = {"force": cfg.push, "unit": "body_weight"}
    push = partial(ExternalPush, duration=PUSH_STEPS, **strength, **moment)
    return "push", PUSH_STEPS, push


def in_words(cfg: DictConfig, force: float) -> str:
    """The filmed disturbance in words."""
    if cfg.knock is not None:
        return f"{cfg.knock} steps of random full-strength actions"
    way = "forwards" if force > 0 else "backwards"
    return f"pushed {way} with {cfg.push:g} x body weight for {PUSH_STEPS} steps"


def players(trained: TrainedRun) -> dict[str, Controller]:
    """Controllers by name, the one that plays until the disturbance is over first.

    It is the last, hence best, behaviour policy of the data; where there is none, the
    trained policy.
    """
    run, norm = trained.config, trained.observation_norm
    model, policy = trained.inverse_dynamics, deterministic_policy(trained.actor, norm)
    learnt: dict[str, Controller] = {"trained policy": lambda _: policy}
    driven: dict[str, Controller] = {}
    if model is not None:
        make = partial(InverseDynamicsController, model, observation_norm=norm)
        driven = {MODEL + rule: partial(make, rule=rule) for rule in RULES}
    names = QUALITIES.get(run.data.quality)
    if not names:
        return learnt | driven
    behavior = load_behavior_policy(run.env.name, names[-1])

    def plays(states: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(behavior.deterministic(states.numpy()))

    return {BEHAVIOR: lambda _: plays} | driven | learnt


def choose(cfg: DictConfig, kept: list[int], up: list[list[bool]]) -> tuple[int, str]:
    """Number of the episode to film, and the reason."""
    if cfg.film_seed is not None:
        if cfg.film_seed - cfg.seed not in kept:
            raise ValueError(
                f"film_seed={cfg.film_seed} is none of the episodes that count: "
                f"{[cfg.seed + each for each in kept]}."
            )
        return cfg.film_seed - cfg.seed, "as asked for"
    for episode, outcomes in zip(kept, zip(*up, strict=True), strict=True):
        if len(set(outcomes)) > 1:
            return episode, "the first with different outcomes"
    return kept[0], "the first; all end alike" if len(up) > 1 else "the first"


if __name__ == "__main__":
    main()
