"""Pictures of a recovery: film strip, moving film and visited states.

Shapes: ``T`` entries of an episode, the reset's first; ``N`` rows of the data, ``S``
observation, ``Q`` joint positions of the simulation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torchrl_osr._files import whole_file
from torchrl_osr.evaluation import drawing
from torchrl_osr.evaluation.drawing import GREY, new_figure, save_figure
from torchrl_osr.film.takeover import PoseRecorder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLORS = (drawing.ORANGE, drawing.GREEN, drawing.BLUE)
"""Of the takes, in their order."""

MARKED = "#A0457E"
"""Colour of the disturbance: the palette's purple, dark enough for text."""

FIELD_OF_VIEW = 38.0
"""Of the camera in degrees: robots fill the picture and stay in it."""

CAMERA_HEIGHT = -0.25
"""Of the camera in metres, relative to the model's: feet are in the picture."""

GIF_STRIDE, GIF_MILLISECONDS = 3, 80
"""Steps between two pictures of the moving film, and duration of each."""

CENTRAL = (0.2, 99.8)
"""Percentiles of the data that the map of visited states shows."""

MARKER: dict[str, Any] = {"markersize": 12, "markeredgecolor": "black", "ls": ""}


@dataclass(frozen=True)
class Take:
    """The episode of the controller ``name``.

    Attributes:
        observations: raw, ``[T, S]``.
        poses: joint positions, ``[T, Q]``.
        begin: entry before the disturbance.
        end: entry after it, at which the controller took over.
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
        """Take of a recorded episode."""
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
        environment: one of Gymnasium's MuJoCo tasks, for the camera alone: the looks of
            its model are changed. Without a camera 'track' it is seen as Gymnasium
            sees it.
        size: of the square picture, in pixels.

    Attributes:
        seconds: duration of one step of the agent.

    Raises:
        ValueError: if it is another environment.
        RuntimeError: if OpenGL does not start.
    """

    def __init__(self, environment: Any, size: int) -> None:
        from gymnasium.envs.mujoco import MujocoEnv
        from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

        simulation = environment.unwrapped
        if not isinstance(simulation, MujocoEnv):
            raise ValueError(
                "only Gymnasium's own MuJoCo tasks can be filmed, 'Hopper-v5' for "
                f"instance: {simulation} has no poses to draw."
            )
        model, self.seconds = simulation.model, float(simulation.dt)
        # No mirror images and shadows: several times faster without a graphics card.
        model.mat_reflectance[:] = 0
        model.vis.quality.shadowsize = 0
        model.cam_fovy[:] = FIELD_OF_VIEW
        model.cam_poscom0[:, 2] += CAMERA_HEIGHT
        self._simulation: Any = simulation
        self._renderer = MujocoRenderer(
            model,
            simulation.data,
            simulation.mujoco_renderer.default_cam_config,
            size,
            size,
            camera_name="track",
        )
        try:
            self._renderer.render("rgb_array")
        # OpenGL libraries fail with all kinds of errors, AttributeError for instance.
        except Exception as error:
            raise RuntimeError(
                "MuJoCo cannot draw here: OpenGL did not start. Set MUJOCO_GL to egl "
                "(no display), osmesa (no graphics driver) or glfw (a display) before "
                f"the start. What went wrong: {error!r}"
            ) from error

    def __call__(self, pose: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Picture ``[size, size, 3]`` of joint positions ``[Q]``."""
        still = np.zeros_like(self._simulation.data.qvel)
        self._simulation.set_state(pose, still)
        picture: NDArray[np.uint8] = self._renderer.render("rgb_array")
        return picture

    def close(self) -> None:
        """Free the graphics memory."""
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
    """Draw one row of pictures for each take, one column for each moment.

    Args:
        takes: all disturbed at the same entries.
        camera: draws the pictures.
        path: the PNG to write.

    Keyword Args:
        title, note: above and below the pictures.
        offsets: steps since the disturbance's end, one for each column.
        event: name of the disturbance.
    """
    rows, columns = len(takes), len(offsets)
    height = 1.6 * rows + 1.7
    figure = new_figure(1.6 * columns + 1.9, height)
    cells = figure.subplots(rows, columns, squeeze=False)
    low = 0.13 / height
    figure.suptitle(title, fontsize=14, y=1 - low)
    figure.text(0.5, low, note, ha="center", va="bottom", fontsize=10, color=GREY)
    figure.subplots_adjust(
        0.13, 0.75 / height, 0.995, 1 - 0.95 / height, wspace=0.03, hspace=0.04
    )
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
    save_figure(figure, path, dpi=110)


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

    Only each :data:`GIF_STRIDE`-th of the ``offsets`` is taken.
    """
    from PIL import Image  # comes with matplotlib

    figure = new_figure(2.3 * max(len(takes), 2), 3.1)  # wide enough for the title
    canvas: Any = figure.canvas
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
        canvas.draw()
        pixels = np.asarray(canvas.buffer_rgba())
        pictures.append(Image.fromarray(pixels[..., :3]))
    # One palette for all, or colours flicker; dithering would not compress.
    some = np.concatenate([np.asarray(each) for each in pictures[::4]])
    palette = Image.fromarray(some).quantize(255)
    first, *others = [
        each.quantize(palette=palette, dither=Image.Dither.NONE) for each in pictures
    ]
    with whole_file(Path(path)) as file:
        first.save(
            file, format="GIF", save_all=True, append_images=others,
            duration=GIF_MILLISECONDS, loop=0,
        )  # fmt: skip


def principal_plane(
    rows: NDArray[np.floating],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The two directions of largest variance, ``[2, S]``, and their shares of it.

    Args:
        rows: centred, ``[N, S]``.
    """
    _, values, directions = np.linalg.svd(np.asarray(rows, float), full_matrices=False)
    plane = directions[:2]
    largest = np.take_along_axis(plane, np.abs(plane).argmax(1)[:, None], 1)
    variance = values**2
    return plane * np.sign(largest), variance[:2] / variance.sum()


def visited_states(
    data: NDArray[np.floating],
    takes: Sequence[Take],
    path: Path | str,
    *,
    title: str,
    note: str,
    event: str,
    steps: int,
) -> None:
    """Draw the data's density in its principal plane, and each take's trail in it.

    Args:
        data: raw observations, ``[N, S]``; standardised here, like the takes.
        takes: drawn from the disturbance's end on, one panel each.
        path: the PNG to write.

    Keyword Args:
        title, note, event: see :func:`film_strip`.
        steps: of each take at most.
    """
    loc, scale = data.mean(0), data.std(0)
    scale = np.where(scale > 0, scale, 1)
    rows = (data - loc) / scale
    plane, shares = principal_plane(rows)
    points, trails = rows @ plane.T, []
    for take in takes:
        # After a fall before the end, the state of the fall is shown.
        seen = take.observations[take.end + min(take.last, 0) :][: steps + 1]
        trails.append((seen - loc) / scale @ plane.T)
    low, high = np.percentile(points, CENTRAL, axis=0)
    low = np.min([low, *(each.min(0) for each in trails)], axis=0) - 0.3
    high = np.max([high, *(each.max(0) for each in trails)], axis=0) + 0.3
    points = points[((points >= low) & (points <= high)).all(1)]
    figure = new_figure(4.2 * max(len(takes), 2) + 1, 5.2, layout="constrained")
    figure.suptitle(f"{title}\n{note}", fontsize=12)
    panels = figure.subplots(1, len(takes), sharey=True, squeeze=False)[0]
    for axes, take, trail, color in zip(panels, takes, trails, COLORS, strict=False):
        cells = axes.hexbin(
            *points.T, gridsize=50, bins="log", cmap="Greys", mincnt=1, linewidths=0,
            extent=(low[0], high[0], low[1], high[1]),
        )  # fmt: skip
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        _draw_trail(axes, take, trail, color, steps)
    panels[0].set_ylabel(f"second principal component ({100 * shares[1]:.0f} %)")
    panels[len(takes) // 2].set_xlabel(
        f"first principal component ({100 * shares[0]:.0f} % of the variance)"
    )
    _legend(figure, event, steps)
    figure.colorbar(cells, ax=panels, label="rows of the data in a cell", pad=0.01)
    save_figure(figure, path, dpi=110)


def _draw_trail(
    axes: Any, take: Take, trail: NDArray[np.float64], color: str, steps: int
) -> None:
    fell = take.fell and take.last <= steps
    end = f"falls after {take.last} steps" if fell else f"up after {steps} steps"
    if fell and take.last < 1:
        end = "falls at once"
    axes.set_title(f"{take.name}\n{end}", color=color, fontsize=12, fontweight="bold")
    # A white border sets it off from dark cells.
    axes.plot(*trail.T, color="white", linewidth=4, alpha=0.7)
    axes.plot(*trail.T, color=color, linewidth=2)
    axes.plot(*trail[:1].T, "o", color="white", **MARKER)
    axes.plot(*trail[-1:].T, "X" if fell else "s", color=color, **MARKER)


def _legend(figure: Figure, event: str, steps: int) -> None:
    from matplotlib.lines import Line2D

    meanings = {"o": f"{event} ends", "X": "fall", "s": f"up {steps} steps later"}
    marks = [
        Line2D([], [], marker=marker, label=label, color="white", **MARKER)
        for marker, label in meanings.items()
    ]
    figure.legend(handles=marks, loc="outside lower center", ncols=3, frameon=False)
