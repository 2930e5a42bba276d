"""A recovery as a film: pictures side by side, and moving ones.

Shapes: ``T`` entries of an episode, the reset's first; ``S`` observation, ``Q`` joint
positions of the simulation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_osr.evaluation.figures import BLUE, GREY, ORANGE, whole_picture
from torchrl_osr.evaluation.takeover import PoseRecorder

try:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
except ImportError as error:
    raise ImportError(
        f"figures need {error.name!r}: pip install torchrl-osr[examples]"
    ) from error

COLORS = (ORANGE, "#009E73", BLUE)
"""Of the takes, in their order: Okabe and Ito's palette."""

MARKED = "#A0457E"
"""The moment of the disturbance: their purple, darker, to be read as text."""

FIELD_OF_VIEW = 38.0
"""Of the camera, in degrees: the robots fill the picture and stay in it."""

CAMERA_HEIGHT = -0.25
"""Of the camera in metres, above where the model has it: feet are in the picture."""

GIF_STRIDE, GIF_MILLISECONDS = 3, 80
"""Steps between two pictures of the moving film, and how long each is shown."""


@dataclass(frozen=True)
class Take:
    """One controller's episode.

    Attributes:
        name: of the controller.
        observations: raw, ``[T, S]``.
        poses: joint positions, ``[T, Q]``.
        begin: entry before the disturbance.
        end: entry after it, which the controller took over at.
        fell: whether the last entry is a fall.
        force: of the push, with its sign; 0 if there was none.
    """

    name: str
    observations: NDArray[np.float32]
    poses: NDArray[np.float64]
    begin: int
    end: int
    fell: bool
    force: float = 0.0

    @classmethod
    def of(
        cls, name: str, recorder: PoseRecorder, episode: int, begin: int, end: int
    ) -> Take:
        """Return a recorded episode as a take."""
        trajectory = recorder.trajectories[episode]
        return cls(
            name, np.stack(trajectory.observations), np.stack(recorder.poses[episode]),
            begin, end, trajectory.terminated, recorder.forces[episode],
        )  # fmt: skip

    @property
    def last(self) -> int:
        """The last entry, in steps since the end; negative after a fall before it."""
        return len(self.poses) - 1 - self.end


class Camera:
    """Draws poses of a MuJoCo robot from the side, without a window.

    Args:
        environment: MuJoCo's; its model's looks are changed, so that it shall be
            nobody else's.
        size: of the square picture, in pixels.

    Attributes:
        seconds: of one step of the agent.

    Raises:
        RuntimeError: if OpenGL does not start, with what to try.
    """

    def __init__(self, environment: Any, size: int) -> None:
        from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

        simulation = environment.unwrapped
        model, self.seconds = simulation.model, float(simulation.dt)
        # Several times faster without a graphics card, and nothing is lost.
        model.mat_reflectance[:] = 0
        model.vis.quality.shadowsize = 0
        model.cam_fovy[:] = FIELD_OF_VIEW
        model.cam_poscom0[:, 2] += CAMERA_HEIGHT
        self._simulation = simulation
        self._renderer = MujocoRenderer(
            model, simulation.data, None, size, size, camera_name="track"
        )
        try:
            self._renderer.render("rgb_array")
        # Every OpenGL library fails in its own way, with AttributeError for instance.
        except Exception as error:
            raise RuntimeError(
                "MuJoCo cannot draw here: OpenGL did not start. Set MUJOCO_GL to egl "
                "(no display), osmesa (no graphics driver) or glfw (a display) before "
                f"the start. What went wrong: {error!r}"
            ) from error

    def __call__(self, pose: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Return the picture ``[size, size, 3]`` of joint positions ``[Q]``."""
        still = np.zeros_like(self._simulation.data.qvel)
        self._simulation.set_state(pose, still)
        picture: NDArray[np.uint8] = self._renderer.render("rgb_array")
        return picture

    def close(self) -> None:
        """Give the graphics memory back."""
        self._renderer.close()  # type: ignore[no-untyped-call]


def film_strip(
    takes: Sequence[Take],
    camera: Camera,
    path: Path | str,
    *,
    title: str,
    note: str,
    offsets: Sequence[int],
    event: str,
) -> None:
    """Draw one row of pictures a take, one column a moment.

    Args:
        takes: all disturbed at the same entries.
        camera: draws the pictures.
        path: the PNG to write.

    Keyword Args:
        title: what happens to whom.
        note: below the pictures; how the episode was chosen, for instance.
        offsets: steps since the disturbance's end, one for each column.
        event: what the disturbance is called.
    """
    rows, columns = len(takes), len(offsets)
    figure = Figure(figsize=(1.6 * columns + 1.9, 1.6 * rows + 1.6))
    FigureCanvasAgg(figure)
    cells = figure.subplots(rows, columns, squeeze=False)
    figure.suptitle(title, fontsize=14, y=0.98)
    figure.text(0.5, 0.02, note, ha="center", va="bottom", fontsize=10, color=GREY)
    figure.subplots_adjust(0.13, 0.12, 0.995, 0.85, wspace=0.03, hspace=0.04)
    begin = takes[0].begin - takes[0].end
    for axes_row, take, color in zip(cells, takes, COLORS, strict=False):
        axes_row[0].set_ylabel(
            _two_lines(take.name), color=color, fontsize=12, fontweight="bold",
            rotation=0, ha="right", va="center", labelpad=10,
        )  # fmt: skip
        for axes, offset in zip(axes_row, offsets, strict=True):
            _show(axes, take, camera, offset)
            if begin <= offset <= 0:
                for spine in axes.spines.values():
                    spine.set(color=MARKED, linewidth=4)
    for axes, offset in zip(cells[0], offsets, strict=True):
        text = _moment(offset, begin, event)
        color = MARKED if begin <= offset <= 0 else "black"
        axes.set_title(
            f"{text}\n{offset * camera.seconds:+.2f} s", fontsize=10, color=color
        )
    with whole_picture(path) as beside:
        figure.savefig(beside, dpi=110, format="png")


def _two_lines(name: str) -> str:
    return name.replace(", ", "\n") if ", " in name else name.replace(" ", "\n", 1)


def _moment(offset: int, begin: int, event: str) -> str:
    if offset == begin:
        return f"{event} begins"
    if offset == 0:
        return f"{event} ends"
    if offset < begin:
        return f"{begin - offset} steps before"
    return f"{offset} steps later"


def _show(axes: Any, take: Take, camera: Camera, offset: int) -> None:
    axes.set(xticks=[], yticks=[])
    axes.imshow(camera(take.poses[take.end + min(offset, take.last)]))
    if take.fell and offset >= take.last:
        axes.images[0].set_alpha(0.35)
        when = f"after\n{take.last} steps" if take.last > 0 else "at once"
        axes.text(
            0.5, 0.92, f"fell {when}", transform=axes.transAxes, ha="center", va="top",
            fontsize=11, fontweight="bold",
        )  # fmt: skip


def film_gif(
    takes: Sequence[Take],
    camera: Camera,
    path: Path | str,
    *,
    title: str,
    note: str,
    offsets: range,
    event: str,
) -> None:
    """Write a moving film of all takes side by side; see :func:`film_strip`.

    Keyword Args:
        offsets: first and last picture; only each :data:`GIF_STRIDE`-th is taken.
    """
    from PIL import Image  # comes with matplotlib

    figure = Figure(figsize=(2.3 * len(takes), 3.1))
    canvas = FigureCanvasAgg(figure)
    cells = figure.subplots(1, len(takes), squeeze=False)[0]
    figure.subplots_adjust(0.01, 0.01, 0.99, 0.70, wspace=0.03)
    figure.suptitle(f"{title}\n{note}", fontsize=8, y=0.98)
    clock = figure.text(0.5, 0.84, "", ha="center", fontsize=10, fontweight="bold")
    for axes, take, color in zip(cells, takes, COLORS, strict=False):
        axes.set_title(
            _two_lines(take.name), color=color, fontsize=9, fontweight="bold", pad=3
        )
    begin, pictures = takes[0].begin - takes[0].end, []
    for offset in offsets[::GIF_STRIDE]:
        acts = begin <= offset <= 0
        clock.set_text(
            f"{offset * camera.seconds:+.2f} s" + (f"  {event}" if acts else "")
        )
        clock.set_color(MARKED if acts else "black")
        for axes, take in zip(cells, takes, strict=True):
            for artist in [*axes.images, *axes.texts]:
                artist.remove()
            _show(axes, take, camera, offset)
            for spine in axes.spines.values():
                spine.set(color=MARKED if acts else GREY, linewidth=4 if acts else 1)
        canvas.draw()  # type: ignore[no-untyped-call]
        pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
        pictures.append(Image.fromarray(pixels[..., :3]))
    # One palette for all, or colours flicker; no dithering, which does not compress.
    some = np.concatenate([np.asarray(each) for each in pictures[::4]])
    palette = Image.fromarray(some).quantize(255)
    first, *others = [
        each.quantize(palette=palette, dither=Image.Dither.NONE) for each in pictures
    ]
    with whole_picture(path) as beside:
        first.save(
            beside, format="GIF", save_all=True, append_images=others,
            duration=GIF_MILLISECONDS, loop=0,
        )  # fmt: skip
