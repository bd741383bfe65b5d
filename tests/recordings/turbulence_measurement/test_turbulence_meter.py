"""Air in footage: known warps are found back with their times and shares; what is refused."""

from itertools import islice

import cv2
import numpy as np
import pytest

from src.calibrate import calibrate, measure_turbulence_in_video
from src.figures import calibration_figures
from src.recordings.files import videos
from src.recordings.files.turbulence_file import IntervalEstimate, read_turbulence_file
from src.recordings.turbulence_measurement import point_tracking, tilt_covariance, turbulence_meter
from tests.test_recording_entry_points import config

SIDE, UNIT = 128, 256 / 128


def scene(side: int = SIDE) -> np.ndarray:
    """Return dark and bright shapes on grey, with edges a pixel wide, in [0, 1]."""
    rng = np.random.default_rng(3)
    picture = np.full((4 * side, 4 * side), 0.5, np.float32)
    for _ in range(160):
        corners = rng.uniform(0, 4 * side, 2) + rng.uniform(-60, 60, (4, 2))
        cv2.fillConvexPoly(
            picture, cv2.convexHull(corners.astype(np.int32)), float(rng.uniform(0.1, 0.9))
        )
    return cv2.resize(picture, (side, side), interpolation=cv2.INTER_AREA)


def fields(half_px: float, rms_px: float, memory: float, frames: int) -> np.ndarray:
    """Return (frames, 2, h, w): Gaussian fields, half length and rms in pixels of SIDE, AR(1)."""
    rng, sigma = np.random.default_rng(1), half_px / 1.665
    pad = int(4 * sigma)
    wide = SIDE + 2 * pad

    def fresh() -> np.ndarray:
        drawn = rng.standard_normal((2, wide, wide)).astype(np.float32)
        soft = np.stack([cv2.GaussianBlur(one, (0, 0), sigma) for one in drawn])
        return soft[:, pad : pad + SIDE, pad : pad + SIDE] * (2 * np.sqrt(np.pi) * sigma * rms_px)

    now, found = fresh(), []
    for _ in range(frames):
        found.append(now)
        now = memory * now + np.sqrt(1 - memory**2) * fresh()
    return np.stack(found)


def film(push: np.ndarray, noise: float = 0.01) -> np.ndarray:
    """Return the scene warped by `push` (frames, 2, h, w), with noise, in steps of 1/255."""
    y, x = np.mgrid[:SIDE, :SIDE].astype(np.float32)
    picture, rng = scene(), np.random.default_rng(2)
    frames = np.stack([
        cv2.remap(picture, x + dx, y + dy, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        for dx, dy in push.astype(np.float32)
    ])  # fmt: skip
    frames += noise * rng.standard_normal(frames.shape).astype(np.float32)
    return np.round(frames.clip(0, 1) * 255).astype(np.float32) / 255


@pytest.mark.parametrize("half_px, rms_px, noise", [(10, 0.7, 0.01), (24, 1.5, 0.02)])
def test_rms_and_half_length_of_known_warps_are_found(half_px, rms_px, noise):
    push = fields(half_px / UNIT, rms_px / UNIT, 0.0, 20)
    found = turbulence_meter.measure_turbulence(film(push, noise), 50.0).found
    rms = push.std(0).mean() * UNIT * np.sqrt(20 / 19)
    assert found.tilt_rms_px.value == pytest.approx(rms, rel=0.1)
    assert found.tilt_correlation_half_length_px.value == pytest.approx(half_px, rel=0.2)
    # What the method errs by counts too.
    assert found.tilt_rms_px.low < 0.87 * found.tilt_rms_px.value
    assert found.tilt_rms_px.high > 1.15 * found.tilt_rms_px.value
    half = found.tilt_correlation_half_length_px
    assert half.low < half_px < half.high
    time_s = found.tilt_correlation_time_s
    assert time_s.value is None and time_s.high == 1 / 50  # new in every frame


def test_tilt_of_many_pixels_of_a_large_frame_is_followed_in_a_smaller_one():
    push = fields(8 / UNIT, 2.2 / UNIT, 0.0, 16)
    small = film(push)
    large = np.stack([
        cv2.resize(frame, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC) for frame in small
    ])  # fmt: skip
    found = turbulence_meter.measure_turbulence(large)
    assert found.picture.shape == (256, 256)
    assert found.found.tilt_rms_px.value == pytest.approx(
        push.std(0).mean() * UNIT * 1.033, rel=0.1
    )
    assert found.found.tilt_correlation_half_length_px.value == pytest.approx(8, rel=0.2)


def test_decay_and_the_share_of_the_whole_view_are_found():
    local = fields(8, 0.4, 0.8, 80)
    rng, whole = np.random.default_rng(5), [np.zeros(2)]
    for _ in range(79):
        whole.append(0.8 * whole[-1] + 0.6 * rng.standard_normal(2))
    whole = 0.4 * np.array(whole) / np.std(whole)
    push = local + whole[:, :, None, None]
    found = turbulence_meter.measure_turbulence(film(push), 100.0).found
    centred = push - push.mean(0)
    truth = (centred.mean((2, 3)) ** 2).mean() / (centred**2).mean()
    assert found.global_tilt_share.value == pytest.approx(truth, abs=0.06)
    time_s = found.tilt_correlation_time_s
    assert time_s.value == pytest.approx(-0.01 / np.log(0.8), rel=0.3)
    assert time_s.low < time_s.value < time_s.high


def test_half_length_beyond_the_frame_is_a_bound():
    rng = np.random.default_rng(0)
    push = np.broadcast_to(rng.normal(0, 0.6, (16, 2, 1, 1)), (16, 2, SIDE, SIDE))
    found = turbulence_meter.measure_turbulence(film(push), 30.0).found
    half = found.tilt_correlation_half_length_px
    assert half.value is None and half.high is None
    assert half.low > 100 and found.global_tilt_share.value > 0.95


def blurred(ratio: float, frames: int = 30) -> np.ndarray:
    """Return frames, a tenth of them blurred by 1.2 px, the rest `ratio` times as much."""
    widths = np.full(frames, 1.2 * ratio)
    widths[::10] = 1.2
    push = fields(10, 0.2, 0.0, frames)
    return np.stack([
        cv2.GaussianBlur(frame, (0, 0), width)
        for frame, width in zip(film(push, 0.0), widths, strict=True)
    ])  # fmt: skip


@pytest.mark.parametrize("ratio", [1.0, pytest.param(1.2, marks=pytest.mark.slow), 1.4, 1.8])
def test_blur_is_what_a_typical_moment_has_beyond_the_sharpest_tenth(ratio):
    frames = blurred(ratio)
    frames += 0.01 * np.random.default_rng(0).standard_normal(frames.shape).astype(np.float32)
    found = turbulence_meter.measure_turbulence(frames).found.blur_px
    beyond = turbulence_meter.SHARPEST_LACKS * found.value / UNIT
    assert beyond == pytest.approx(1.2 * np.sqrt(ratio**2 - 1), rel=0.2, abs=0.25)
    assert found.low < found.value < found.high


def test_bands_of_lamps_are_no_blur():
    """A rolling shutter under mains lamps: bands that run over the frame."""
    frames, row = film(fields(10 / UNIT, 0.5 / UNIT, 0.0, 20)), np.arange(SIDE)[:, None]
    lit = [f * (1 + 0.2 * np.sin(row / 14 + 2.3 * k)) / 1.2 for k, f in enumerate(frames)]
    found = turbulence_meter.measure_turbulence(np.stack(lit).astype(np.float32), 50.0).found
    plain = turbulence_meter.measure_turbulence(frames, 50.0).found
    assert found.blur_px.value == pytest.approx(plain.blur_px.value, abs=0.3)
    assert plain.blur_px.low == 0.001


@pytest.mark.parametrize("frames", [1.44, 2.0, 6.3])
def test_a_decay_of_a_frame_or_two_is_that_of_its_exponential(frames):
    correlation = np.exp(-np.arange(20) / frames)
    assert tilt_covariance.find_decay_lag(correlation) == pytest.approx(frames, rel=1e-6)
    assert tilt_covariance.find_decay_lag(correlation[:1]) == np.inf


def test_blur_is_that_of_a_frame_of_256_px():
    large = np.stack([
        cv2.resize(frame, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
        for frame in blurred(1.4, 20)
    ])  # fmt: skip
    small = np.stack([turbulence_meter.limit_shorter_side(frame, 256) for frame in large])
    found, wanted = (
        turbulence_meter.measure_turbulence(frames).found.blur_px for frames in (large, small)
    )
    assert found.value == pytest.approx(wanted.value, rel=0.08)  # seen at 512 px it is 0.8 of it


def test_points_lie_on_corners_not_on_edges():
    picture = np.full((128, 128), 0.2, np.float32)
    picture[40:90, 30:] = 0.8
    found = point_tracking.find_corners(picture)
    assert len(found) > 0
    apart = np.hypot(found[:, 0] - 30, np.minimum(abs(found[:, 1] - 40), abs(found[:, 1] - 90)))
    assert apart.max() < 5


@pytest.mark.parametrize("noise", [0.01, 0.03])
def test_noise_of_the_two_displacements_is_independent(noise):
    frames = film(np.zeros((30, 2, SIDE, SIDE)), noise)
    tracks = point_tracking.track_points(frames, point_tracking.find_corners(frames.mean(0)))
    first, second = tilt_covariance.centre_displacements(
        tracks.select(tracks.seen.mean(0) > turbulence_meter.MIN_FOUND)
    )
    assert abs((first * second).mean()) < 0.1 * (first**2).mean()


@pytest.mark.parametrize("noise", [pytest.param(0.03, marks=pytest.mark.slow), 0.05])
def test_noise_alone_is_no_tilt(noise):
    frames = film(np.zeros((60, 2, SIDE, SIDE)), noise)
    with pytest.raises(ValueError, match=r"turbulent air, got a tilt of 0.0\d* .* at \d\d+ points"):
        turbulence_meter.measure_turbulence(frames, 30.0)


@pytest.mark.parametrize("quality", [50, pytest.param(75, marks=pytest.mark.slow)])
def test_what_compression_adds_is_no_tilt(quality):
    files = [
        cv2.imencode(".jpg", np.uint8(255 * frame), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        for frame in film(np.zeros((40, 2, SIDE, SIDE)))
    ]
    frames = [cv2.imdecode(file, cv2.IMREAD_GRAYSCALE) for file in files]
    with pytest.raises(ValueError, match=r"a tilt of 0.0\d* .* px: errors of compression, too,"):
        turbulence_meter.measure_turbulence(np.stack(frames).astype(np.float32) / 255, 30.0)


def test_weak_tilt_in_noise_is_not_underestimated():
    push = fields(10 / UNIT, 0.12 / UNIT, 0.5, 40)
    found = turbulence_meter.measure_turbulence(film(push, 0.03)).found.tilt_rms_px
    assert found.value == pytest.approx(0.12, rel=0.3)


def drift(frames: int, x_px: float, y_px: float, zoom: float, roll: float) -> np.ndarray:
    """Return (frames, 2, h, w): a shift in pixels, a growth and a rotation over the whole film."""
    y, x = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    whole = np.stack([x_px + zoom * x - roll * y, y_px + zoom * y + roll * x])
    return np.linspace(-0.5, 0.5, frames)[:, None, None, None] * whole


@pytest.fixture(scope="module")
def shaken():
    """Warps, and what is measured of them."""
    push = fields(10 / UNIT, 0.4 / UNIT, 0.5, 40)
    return push, turbulence_meter.measure_turbulence(film(push), 30.0)


@pytest.mark.parametrize("moved", [(1.5, 0, 0, 0), (0, -1.5, 0.02, 0), (0, 0, 0, 0.02)])
def test_drift_of_the_camera_is_taken_off(moved, shaken):
    (push, alone), slow = shaken, drift(40, *moved)
    found = turbulence_meter.measure_turbulence(film(push + slow), 30.0)
    assert alone.camera_drift_px == 0 and "camera_drift_px" not in alone.summary()
    inside = slice(12, -12)  # where corners are looked for
    way = np.hypot(*(slow[-1] - slow[0])[:, inside, inside]).max() * UNIT
    assert found.camera_drift_px == pytest.approx(way, rel=0.3)
    assert found.found.tilt_rms_px.value == pytest.approx(alone.found.tilt_rms_px.value, rel=0.05)
    assert found.found.global_tilt_share.value < 0.1
    times = [one.found.tilt_correlation_time_s.value for one in (found, alone)]
    assert times[0] == pytest.approx(times[1], rel=0.15)


def test_drift_alone_is_no_tilt():
    with pytest.raises(ValueError, match="a tilt of 0.0"):
        turbulence_meter.measure_turbulence(film(drift(40, 1.0, 0, 0, 0)), 30.0)


def test_turbulence_as_slow_as_the_film_is_known_by_bounds():
    push = fields(6, 0.4, np.exp(-1 / 30), 60)  # 1/e after half of the film
    found = turbulence_meter.measure_turbulence(film(push), 30.0)
    assert found.camera_drift_px == 0  # its trends differ from point to point
    decay, rms = found.found.tilt_correlation_time_s, found.found.tilt_rms_px
    assert decay.value is None and decay.high is None and 0.1 < decay.low < 1.0
    assert rms.low < 0.4 * UNIT < rms.high  # a part goes with the mean
    assert rms.high > 1.6 * rms.value


def pan(px: float) -> np.ndarray:
    push = np.zeros((16, 2, SIDE, SIDE), np.float32)
    push[:, 0] = np.linspace(0, px, 16)[:, None, None]
    return film(push)


@pytest.mark.parametrize(
    "frames, message",
    [
        (lambda: film(np.zeros((10, 2, SIDE, SIDE))), "at least 16 frames, got 10"),
        (lambda: film(np.zeros((16, 2, SIDE, SIDE))), "through turbulent air, got a tilt of 0.00"),
        (lambda: np.full((20, 64, 64), 0.5, np.float32), "must show texture, .* got 0"),
        (lambda: pan(9.0), "stands still, got one that moves by .* px of 256; .*% of"),
        (lambda: pan(90.0), r"stands still.*% .*could be tracked"),
    ],
)
def test_footage_that_shows_too_little_is_refused(frames, message):
    with pytest.raises(ValueError, match=message) as caught:
        turbulence_meter.measure_turbulence(frames(), 25.0)
    assert "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder of pictures of a scene through air."""
    folder = tmp_path_factory.mktemp("site") / "pictures"
    folder.mkdir()
    for number, frame in enumerate(film(fields(8, 0.5, 0.5, 16))):
        cv2.imwrite(str(folder / f"{number:03}.png"), np.round(frame * 255))
    return folder


@pytest.mark.parametrize(
    ("correlation", "title"),
    [(1.12, "tracking error: 0.12 above the fit at distance 0"), (0.9, ""), (float("nan"), "")],
)
def test_an_excess_at_distance_0_is_told_where_there_is_one(correlation, title):
    assert calibration_figures.describe_tracking_error(correlation) == title


def test_calibrate_writes_a_file_and_a_figure(folder, tmp_path):
    run, save = tmp_path / "run", tmp_path / "air.yaml"
    calibrate(config("calibrate", run, "task=air", f"video={folder}", f"save={save}"))
    found = read_turbulence_file(save)
    # Pictures have no frame rate.
    assert found.tilt_correlation_time_s == IntervalEstimate(None, None, None)
    assert save.read_text() == (run / "air.yaml").read_text()
    assert cv2.imread(str(run / "air.png")).std() > 10
    again = config("calibrate", run, "task=air", f"video={folder}", "fps=50.0")
    timed = measure_turbulence_in_video(again, run)
    time_s = timed.found.tilt_correlation_time_s.value
    assert time_s == pytest.approx(timed.tilt.decay_frames / 50)
    assert timed.found.tilt_rms_px.value == pytest.approx(found.tilt_rms_px.value, rel=1e-3)


@pytest.mark.parametrize(
    "wrong, message",
    [
        ("video=nowhere", "video must be a film or a folder of pictures, got nowhere"),
        ("fps=0", "fps must be in"),
        ("fps=1e30", r"fps must be in \[0.02, 1e5\] frames a second, got 1e\+30"),
        ("save=/tmp", "save must be a file to write, got /tmp: a folder"),
        ("air.max_frames=5", "air.max_frames must be at least 16"),
        ("air.max_frames=16 fps=inf", "fps must be in"),
    ],
)
def test_calibrate_refuses_and_writes_nothing(folder, wrong, message, tmp_path):
    chosen = ["task=air", f"video={folder}", f"save={tmp_path}/air.yaml", *wrong.split()]
    with pytest.raises(ValueError, match=message):
        calibrate(config("calibrate", tmp_path / "run", *chosen))
    assert not (tmp_path / "air.yaml").exists() and not list((tmp_path / "run").iterdir())


def test_footage_of_a_building_and_of_a_panning_camera(shared_data):
    found = turbulence_meter.measure_turbulence(
        _frames(shared_data / "turbulence/building", slice(16))
    ).found
    assert 0.6 < found.tilt_rms_px.value < 0.95
    assert 5 < found.tilt_correlation_half_length_px.value < 20
    assert 0.1 < found.global_tilt_share.value < 0.45
    with pytest.raises(ValueError, match="stands still"):
        turbulence_meter.measure_turbulence(
            _frames(shared_data / "turbulence/TSR_phys_0212.mp4", slice(0, 80, 5))
        )


def _frames(path, chosen: slice) -> np.ndarray:
    frames = islice(videos.read_video(path), chosen.start, chosen.stop, chosen.step)
    return np.stack([turbulence_meter.limit_shorter_side(frame) for frame in frames])
