"""Pictures of an episode: what the radar looks at, what it believes, what is true.

    episode = record_episode(env, params, policy, key)
    animate(episode, "episode.gif")

and the same as a command: ``python -m jaxtrack.render --policy index --seed 0 --out episode.gif``.
"""

import dataclasses
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import numpy as np

from jaxtrack.cli import LARGEST_SEED, parse, require_file, require_integer, run
from jaxtrack.policies import POLICIES
from jaxtrack.recording import Episode, record_episode
from jaxtrack.scenarios import read_scenario
from jaxtrack.scene import Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from PIL.Image import Image

__all__ = ["Episode", "animate", "draw_frame", "record_episode", "save_frame"]

FRAMES = 100
"""Frames of an animation whose stride is not given."""
FRESH_FRAMES = 3
"""Detections stay visible for this many frames."""
HOLD_LAST = 1500
"""How long a GIF rests on its last frame before it repeats (ms)."""
LARGEST_STEPS = 1_000_000
"""Longest episode; all its states are kept in memory."""
LARGEST_FPS = 100
"""A GIF counts time in hundredths of a second."""
COLOURS = 64
"""Colours of a GIF, the same ones in every frame."""
SUFFIXES = (".gif", ".mp4", ".png")


def draw_frame(episode: Episode, step: int = -1, stride: int = 10) -> "Figure":
    """Figure of one step; negative steps count from the end.

    Args:
        episode: what to draw.
        step: which moment.
        stride: the looks of this many steps are drawn, older ones faintly.
    """
    scene = Scene(episode)
    _show(scene, range(len(episode))[step], stride)
    return scene.figure


def save_frame(episode: Episode, path: str | Path, step: int = -1, stride: int = 10) -> None:
    """Writes one step as a picture of the format that the suffix names."""
    draw_frame(episode, step, stride).savefig(path)


def animate(
    episode: Episode, path: str | Path, fps: int = 20, stride: int | None = None, progress: bool = False
) -> int:
    """Writes the episode as a GIF, or as an MP4 where ffmpeg is installed.

    Args:
        episode: what to draw.
        path: file to write; its suffix chooses the format.
        fps: frames per second of the result.
        stride: steps per frame; chosen for about 100 frames where not given.
        progress: show a bar on standard error.

    Returns:
        The number of frames.

    Raises:
        ValueError: if the suffix is neither, or MP4 is asked for without ffmpeg.
    """
    path = Path(path)
    stride = stride or max(1, len(episode) // FRAMES)
    steps = range(stride - 1, len(episode), stride) or range(len(episode) - 1, len(episode))
    scene = Scene(episode)
    shown = _shown(scene, _with_bar(steps, progress), stride)
    if path.suffix == ".gif":
        _write_gif(shown, path, fps)
    elif path.suffix == ".mp4":
        _write_mp4(shown, scene.figure, path, fps)
    else:
        raise ValueError(f"path = {str(path)!r}: expected a name that ends in .gif or .mp4")
    return len(steps)


def _show(scene: Scene, step: int, stride: int) -> None:
    scene.show(step, since=step - stride + 1, fresh_since=step - FRESH_FRAMES * stride + 1)


def _shown(scene: Scene, steps: Iterable[int], stride: int) -> Iterator["Image"]:
    """Pictures of the steps, one after the other; what stands still is drawn only once."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    canvas = FigureCanvasAgg(scene.figure)
    for artist in scene.moving:
        artist.set_animated(True)
    canvas.draw()
    background = canvas.copy_from_bbox(scene.figure.bbox)
    for step in steps:
        _show(scene, step, stride)
        canvas.restore_region(background)
        for artist in scene.moving:
            artist.draw(canvas.get_renderer())
        yield Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


def _with_bar(steps: Iterable[int], progress: bool) -> Iterable[int]:
    from rich.console import Console
    from rich.progress import track

    return track(steps, "drawing", console=Console(stderr=True), disable=not progress, transient=True)


def _write_gif(pictures: Iterator["Image"], path: Path, fps: int) -> None:
    """One palette for all frames: then only what moved has to be stored."""
    from PIL import Image

    frames = list(pictures)
    width, height = frames[0].size
    sample = Image.new("RGB", (width, 3 * height))
    for row, index in enumerate((0, len(frames) // 2, -1)):
        sample.paste(frames[index], (0, row * height))
    # Two rounds of k-means keep greys free of tint.
    palette = sample.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, 2, dither=Image.Dither.NONE)
    indexed = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [round(1000 / fps)] * (len(frames) - 1) + [HOLD_LAST]
    indexed[0].save(path, save_all=True, append_images=indexed[1:], duration=durations, loop=0)


def _write_mp4(pictures: Iterator["Image"], figure: "Figure", path: Path, fps: int) -> None:
    from matplotlib.animation import FFMpegWriter

    if not FFMpegWriter.isAvailable():
        raise ValueError(f"path = {str(path)!r}: MP4 needs ffmpeg, which is not installed; use .gif")
    writer = FFMpegWriter(fps=fps)
    with writer.saving(figure, str(path), figure.dpi):
        for _ in pictures:
            writer.grab_frame()


@dataclasses.dataclass(frozen=True)
class Options:
    """Plays one episode and draws it."""

    policy: str = "index"
    """Policy by name: random, static, coverage, stalest, scheduler, index, index_tuned, gain, sweep or
    sweep_then_track."""
    scenario: str = "paper"
    """Scenario by name, or a file: as in train.evaluate; the datasheet lists them."""
    seed: int = 0
    """Seed of the scenario and of the policy."""
    steps: int = 1000
    """Length of the episode (steps)."""
    out: Path = Path("episode.gif")
    """Picture to write: .gif, .mp4 (needs ffmpeg), or .png for the last step only."""
    fps: int = 20
    """Frames per second of the animation."""
    stride: int = 0
    """Steps per frame; 0 chooses about 100 frames."""


def check(options: Options) -> None:
    """Raises ValueError, naming the field, for an option that makes no sense."""
    if options.policy not in POLICIES:
        raise ValueError(f"policy = {options.policy!r}: expected one of {', '.join(POLICIES)}")
    for name, low, high in (
        ("seed", 0, LARGEST_SEED),
        ("steps", 1, LARGEST_STEPS),
        ("fps", 1, LARGEST_FPS),
        ("stride", 0, options.steps),
    ):
        require_integer(name, getattr(options, name), low, high)
    out = options.out
    if out.suffix not in SUFFIXES:
        raise ValueError(f"out = {str(out)!r}: expected a name that ends in {', '.join(SUFFIXES)}")
    require_file("out", out)


def draw(options: Options) -> str:
    """Records and draws what the options ask for; returns what was done, in one line."""
    from jaxtrack.env import make

    started = time.perf_counter()
    env, params = make(**read_scenario(options.scenario))
    policy = POLICIES[options.policy](env.static, params)
    episode = record_episode(env, params, policy, jax.random.key(options.seed), options.steps)
    recorded = time.perf_counter()
    if options.out.suffix == ".png":
        save_frame(episode, options.out)
        frames = 1
    else:
        frames = animate(episode, options.out, options.fps, options.stride or None, sys.stderr.isatty())
    drawn = time.perf_counter()
    return (
        f"{options.out}: frames {frames}, {options.out.stat().st_size / 1000:.0f} kB; {options.steps} steps "
        f"of {options.policy} played in {recorded - started:.1f} s, drawn in {drawn - recorded:.1f} s"
    )


def main(argv: Sequence[str]) -> int:
    """The command."""
    options = parse(Options(), argv, "python -m jaxtrack.render")
    check(options)
    print(draw(options))
    return 0


if __name__ == "__main__":
    run(main)
