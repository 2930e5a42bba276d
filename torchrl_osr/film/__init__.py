"""Films of a recovery: several controllers that go on from the same disturbed state.

* :func:`play_takeovers` plays the episodes, :func:`survival_table` counts survivors;
* :class:`InverseDynamicsController` is the inverse dynamics model as a controller;
* :func:`film_strip`, :func:`film_gif` and :func:`visited_states` draw one episode.

``torchrl-osr film`` puts them together, ``docs/film.md`` has the meaning.
"""

from torchrl_osr.film.control import InverseDynamicsController
from torchrl_osr.film.pictures import (
    Camera,
    Take,
    film_gif,
    film_strip,
    visited_states,
)
from torchrl_osr.film.takeover import (
    BEHAVIOR,
    Controller,
    PoseRecorder,
    Survival,
    Takeover,
    play_takeovers,
    survival_table,
)

__all__ = [
    "BEHAVIOR",
    "Camera",
    "Controller",
    "InverseDynamicsController",
    "PoseRecorder",
    "Survival",
    "Take",
    "Takeover",
    "film_gif",
    "film_strip",
    "play_takeovers",
    "survival_table",
    "visited_states",
]
