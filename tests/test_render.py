import itertools
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from jaxtrack import metrics, render, scene
from jaxtrack.cli import run
from jaxtrack.env import make
from jaxtrack.models import direction
from jaxtrack.sensor import in_beam

pytestmark = pytest.mark.usefixtures("quick_compilation")

STEPS = 24


def sweep(key, state):
    """Azimuth index from the episode's key and the time, elevation index from the number of tracks."""
    azimuth = jax.random.randint(key, (), 0, 19) + state.time
    return jnp.stack([azimuth % 19, 5 + jnp.sum(state.tracks.active)])


@pytest.fixture(scope="module")
def episode():
    env, params = make(num_truths=30, max_tracks=9)
    return render.record_episode(env, params, sweep, jax.random.key(1), STEPS)


def test_the_policy_gets_the_state_before_the_step_and_one_key(episode):
    step = np.radians(120) / 18
    azimuth, elevation = np.round((episode.records.look + np.radians(60)) / step).astype(int).T
    np.testing.assert_array_equal(np.diff(azimuth) % 19, 1)
    before = np.concatenate([[0], episode.states.tracks.active.sum(-1)[:-1]])
    np.testing.assert_array_equal(elevation, 5 + before)
    assert before[-1] > 1


def test_a_recording_has_every_step_with_its_metrics(episode):
    np.testing.assert_array_equal(episode.states.time, np.arange(1, STEPS + 1))
    assert len(episode) == STEPS == len(episode.gospa)
    _, params = make()
    last = jax.tree.map(lambda rows: rows[-1], episode.states)
    completeness = metrics.completeness(last.truths, last.tracks, params)
    distance = metrics.gospa(last.truths, last.tracks, params).distance
    assert episode.completeness[-1] == pytest.approx(float(completeness))
    assert episode.gospa[-1] == pytest.approx(float(distance), rel=1e-5)


def test_a_recording_needs_a_step():
    env, params = make()
    with pytest.raises(ValueError, match="num_steps = 0"):
        render.record_episode(env, params, sweep, jax.random.key(0), 0)


def test_importing_the_module_does_not_import_matplotlib():
    code = "import sys, jaxtrack.render; print('matplotlib' in sys.modules)"
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    result = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "False"


@pytest.mark.parametrize("look", [(0.0, 0.0), (1.0, 1.0), (-0.7, -1.04)])
def test_the_beam_outline_is_the_edge_of_what_the_sensor_sees(look):
    _, params = make()
    look = jnp.array(look)
    outline = scene.beam_outline(look, params)
    for scale, expected in ((0.98, True), (1.02, False)):
        azimuth, elevation = (look + scale * (outline - look)).T
        inside = in_beam(direction(azimuth, elevation), look, params)
        assert np.all(np.asarray(inside) == expected)


def test_track_ellipses_agree_with_sampled_angles():
    rng = np.random.default_rng(0)
    mean = np.array([3000.0, 10.0, 1500.0, -20.0, 2000.0, 5.0])
    factor = rng.normal(size=(6, 6)) * 10
    samples = mean + rng.normal(size=(100_000, 6)) @ factor.T
    sampled = np.cov(np.asarray(scene.angles(jnp.asarray(samples))).T)
    computed = scene.angle_covariance(jnp.asarray(mean), jnp.asarray(factor @ factor.T))
    np.testing.assert_allclose(computed, sampled, rtol=0.03, atol=1e-3)

    outline = scene.ellipses(np.zeros((1, 2)), sampled[None])[0]
    distance = np.einsum("pi,ij,pj->p", outline, np.linalg.inv(sampled), outline)
    np.testing.assert_allclose(np.sqrt(distance), scene.SIGMAS * scene.ENLARGED, rtol=1e-6)


@pytest.mark.parametrize(("stride", "frames"), [(8, 3), (7, 3), (24, 1), (100, 1)])
def test_a_gif_has_one_frame_per_stride_and_moves(episode, tmp_path, stride, frames):
    path = tmp_path / "episode.gif"
    assert render.animate(episode, path, fps=10, stride=stride) == frames
    with Image.open(path) as image:
        assert image.format == "GIF"
        assert image.n_frames == frames
        assert image.size == (800, 480)
        pictures = []
        for frame in range(frames):
            image.seek(frame)
            pictures.append(np.asarray(image.convert("RGB")))
    assert all(np.any(before != after) for before, after in itertools.pairwise(pictures))


def test_a_frame_of_an_animation_looks_like_the_picture_of_its_step(episode, tmp_path):
    render.animate(episode, tmp_path / "a.gif", stride=8)
    render.save_frame(episode, tmp_path / "a.png", step=15, stride=8)
    with Image.open(tmp_path / "a.gif") as moving, Image.open(tmp_path / "a.png") as still:
        moving.seek(1)
        difference = np.asarray(moving.convert("RGB"), float) - np.asarray(still.convert("RGB"), float)
    assert np.abs(difference).mean() < 1.0


def test_a_frame_shows_what_happened_at_its_step(episode):
    step = int(np.argmax(episode.states.tracks.active.sum(-1)))
    drawn = scene.Scene(episode)
    drawn.show(step, since=0)
    active = episode.states.tracks.active[step]
    assert active.any()
    centres = np.asarray(drawn.field_tracks.centres.get_offsets())
    expected = scene.angles(episode.states.tracks.mean[step][active])
    np.testing.assert_allclose(centres, expected, rtol=1e-5)
    assert len(drawn.field_tracks.outlines.get_paths()) == active.sum()
    assert len(drawn.detections.get_xdata()) == episode.records.detections.active[: step + 1].sum()
    np.testing.assert_array_equal(drawn.image.get_array(), episode.states.scan_map[step])
    assert f"look {step + 1}" in drawn.headline.get_text()


def test_drawing_leaves_no_open_figures(episode, tmp_path):
    from matplotlib import pyplot

    render.save_frame(episode, tmp_path / "frame.png")
    render.animate(episode, tmp_path / "episode.gif", stride=24)
    assert pyplot.get_fignums() == []


def test_wrong_formats_are_refused_by_name(episode, tmp_path, monkeypatch):
    from matplotlib.animation import FFMpegWriter

    with pytest.raises(ValueError, match=r"\.gif or \.mp4"):
        render.animate(episode, tmp_path / "episode.avi")
    monkeypatch.setattr(FFMpegWriter, "isAvailable", classmethod(lambda cls: False))
    with pytest.raises(ValueError, match="ffmpeg"):
        render.animate(episode, tmp_path / "episode.mp4")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (["--policy", "best"], "policy"),
        (["--steps", "0"], "steps"),
        (["--seed", "-1"], "seed"),
        (["--fps", "0"], "fps"),
        (["--stride", "-1"], "stride"),
        (["--out", "a.txt"], "out"),
        (["--out", "no/such/folder/a.gif"], "out"),
    ],
)
def test_the_command_names_the_wrong_option_in_one_line(arguments, name, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["render", *arguments])
    with pytest.raises(SystemExit) as stopped:
        run(render.main)
    assert stopped.value.code == 2
    message = capsys.readouterr().err
    assert message.startswith(f"error: {name} = ")
    assert message.count("\n") == 1


def test_the_command_writes_a_picture_and_says_so(episode, tmp_path, monkeypatch, capsys):
    asked = []

    def record(env, params, policy, key, num_steps):
        asked.append((env.static.num_truths, jax.random.key_data(key).tolist(), num_steps))
        return episode

    out = tmp_path / "last.png"
    arguments = ["--policy", "random", "--seed", "7", "--steps", "24", "--out", str(out)]
    monkeypatch.setattr(render, "record_episode", record)
    assert render.main(arguments) == 0
    captured = capsys.readouterr()
    assert asked == [(10, [0, 7], 24)]
    assert captured.out.startswith(f"{out}: frames 1, ")
    assert captured.err == ""
    with Image.open(out) as image:
        assert image.size == (800, 480)
