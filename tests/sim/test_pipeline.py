"""The laws of the whole chain (numbers as in docs/conventions.md)."""

import math
from dataclasses import replace

import pytest
import torch

from src.sim.optics import Optics
from src.sim.pipeline import Pipeline, simulate
from src.sim.scenes.clip import Clip
from src.sim.sensor import EventSensor
from src.sim.turbulence.simulated import SimulatedTurbulence

IDEAL = {"threshold": 0.2, "refractory_s": 0.0}
STRONG = SimulatedTurbulence({"severity": "strong"})
CALM = SimulatedTurbulence({"severity": "none"})


class Waves:
    """A scene of two drifting gratings; a function of the index."""

    def __init__(self, frames: int = 5, side: int = 48, contrast: float = 0.35):
        self.frames, self.side, self.contrast = frames, side, contrast

    def clip(self, index: int) -> Clip:
        x = torch.arange(self.side).float()
        phase = torch.arange(self.frames).float().reshape(-1, 1, 1) * 0.4 + index
        frames = 0.5 + self.contrast * torch.sin(0.35 * x + phase) * torch.cos(
            0.22 * x[:, None] - phase
        )
        return Clip(frames, 120.0, f"waves{index}")


def pipeline(turbulence=CALM, sensor=IDEAL, optics=None, scene=None, **kwargs) -> Pipeline:
    srgb = sensor.get("input") == "srgb"
    pixels = EventSensor(**sensor | {"input": "linear"})
    optics, scene = optics or Optics(9), scene or Waves()
    kwargs = {"split": "test", "decodes_srgb": srgb} | kwargs
    return Pipeline(scene, optics, turbulence, pixels, **kwargs)


def test_law_1_without_turbulence_events_follow_the_log_intensity_within_a_threshold():
    chain = pipeline()
    sample = simulate(chain, [3])
    frames = chain.scene.clip(3).frames
    summed = IDEAL["threshold"] * sample.voxels.sum(3).cumsum(1)  # (1, windows, views, h, w)
    change = (frames[1:] / frames[0]).log()[None, :, None]
    assert float((summed - change).abs().max()) < IDEAL["threshold"] + 1e-5
    assert float(summed.abs().max()) > 3 * IDEAL["threshold"]
    assert torch.equal(sample.target[0, :, 0], frames[1:])


def test_law_2_single_is_the_centre_view_of_3x3():
    nine = simulate(pipeline(STRONG, optics=Optics(9)), [5])
    one = simulate(pipeline(STRONG, optics=Optics(1)), [5])
    assert torch.equal(nine.voxels[:, :, 4:5], one.voxels)
    assert torch.equal(nine.turbulent, one.turbulent)
    assert int((nine.voxels[:, :, 0] != nine.voxels[:, :, 4]).sum()) > 100


def test_law_3_a_view_depends_on_its_own_draws_only():
    all_nine = simulate(pipeline(STRONG), [5]).voxels
    some = Optics(3, positions=[(1, 1), (0, 0), (-1, 0)])
    chosen = simulate(pipeline(STRONG, optics=some), [5]).voxels
    assert torch.equal(all_nine[:, :, [8, 4, 1]], chosen)


def test_law_3_a_sample_does_not_depend_on_its_batch():
    chain = pipeline(STRONG, sensor={"threshold": [0.1, 0.7], "dark_noise_hz": 5.0})
    together, alone = simulate(chain, [4, 9]), simulate(chain, [9])
    assert torch.equal(together.voxels[1:], alone.voxels)
    assert together.parameters[1] == alone.parameters[0]
    assert together.parameters[0]["threshold"] != together.parameters[1]["threshold"]


class MixedRates(Waves):
    """Clips of 60 to 180 frames a second."""

    def clip(self, index: int) -> Clip:
        return replace(super().clip(index), fps=60.0 + 40 * (index % 4))


DRAWN = {
    "threshold": [0.1, 0.4],
    "random": {
        "off_ratio": [0.7, 1.5], "refractory_s": [0.0005, 0.02], "mismatch": [0.0, 0.2],
        "dark_noise_hz": [0.0, 20.0], "leak_event_hz": [0.0, 2.0], "hot_pixel_fraction": [0.0, 0.1],
        "hot_pixel_hz": [1.0, 50.0], "cutoff_hz": [20.0, 200.0],
        "initial_reference_error": [0.05, 1.0],
    },
}  # fmt: skip


@pytest.mark.parametrize("source", ["linear", "srgb"])
def test_law_3_a_batch_at_once_is_its_clips_one_by_one(source):
    """Rates, crops and all that is drawn of a sensor differ from clip to clip."""
    chain = pipeline(
        STRONG, DRAWN | {"input": source}, Optics(3), MixedRates(frames=6), crop=16,
        random_crop=True, substeps=2,
    )  # fmt: skip
    draws = [chain.draw(number) for number in (4, 9, 2)]
    whole, parts = (chain.simulate(draws, batched=batched) for batched in (True, False))
    alone = [chain.simulate([draw]) for draw in draws]
    for name in ("voxels", "target", "turbulent", "window_s"):
        theirs = torch.cat([getattr(sample, name) for sample in alone])
        assert torch.equal(getattr(whole, name), theirs), name
        assert torch.equal(getattr(parts, name), theirs), name
    assert whole.parameters == parts.parameters == [sample.parameters[0] for sample in alone]
    assert whole.voxels.is_contiguous() and whole.voxels.flatten(1).any(1).all()
    assert len(set(whole.window_s.tolist())) == 3


def test_views_in_float16_are_taken_as_if_they_had_been_widened():
    chain = pipeline(STRONG, DRAWN | {"input": "srgb"})
    draws = [chain.draw(number) for number in (4, 9)]
    views = chain.render_views(draws).half()
    ours, theirs = (chain.simulate_sensor(draws, seen) for seen in (views, views.float()))
    for name in ("voxels", "target", "turbulent"):
        assert torch.equal(getattr(ours, name), getattr(theirs, name)), name


def test_a_batch_of_several_sizes_is_refused():
    draws = [pipeline(crop=crop).draw(0) for crop in (16, 24)]
    with pytest.raises(ValueError, match=r"one size .*got \[\(5, 16, 16\), \(5, 24, 24\)\]"):
        pipeline().simulate(draws)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_gives_the_same_sample():
    chain = pipeline(STRONG)
    ours, theirs = simulate(chain, [5]), simulate(chain, [5], "cuda").to("cpu")
    assert torch.equal(ours.target, theirs.target)
    torch.testing.assert_close(ours.turbulent, theirs.turbulent, atol=1e-3, rtol=0)
    assert moved(ours.voxels, theirs.voxels) < 0.01


def test_light_that_differs_by_rounding_moves_few_events():
    """What two devices may differ by: a hundred times what their light does."""
    chain = pipeline(STRONG)
    draw = chain.draw(5)
    views = chain.render_views([draw])
    rounding = 1e-5 * (2 * torch.rand(views.shape, generator=torch.Generator().manual_seed(0)) - 1)
    ours, theirs = (chain.simulate_sensor([draw], seen) for seen in (views, views + rounding))
    assert 0 < moved(ours.voxels, theirs.voxels) < 0.001


def moved(ours: torch.Tensor, theirs: torch.Tensor) -> float:
    """Return the share of events that are elsewhere, in place or in time."""
    return float((ours - theirs).abs().sum() / ours.abs().sum())


def test_law_5_a_crop_is_the_crop_of_the_whole_away_from_the_border():
    sensor = {"threshold": 0.3, "dark_noise_hz": 20.0, "mismatch": 0.1}
    whole = simulate(pipeline(STRONG, sensor, scene=Waves(side=96)), [2])
    crop = simulate(pipeline(STRONG, sensor, scene=Waves(side=96), crop=48), [2])
    assert crop.voxels.shape[-2:] == (48, 48)
    inner = (whole.voxels[..., 24:72, 24:72] - crop.voxels).abs() > 1e-4
    # The same light to float rounding: a crossing may fall on the other side of a tie.
    assert float(inner.float().mean()) < 2e-3
    assert torch.equal(whole.target[..., 24:72, 24:72], crop.target)


def test_law_7_a_flat_scene_stays_flat_and_makes_no_event():
    sample = simulate(pipeline(STRONG, scene=Waves(contrast=0.0)), [1])
    assert torch.allclose(sample.turbulent, torch.full_like(sample.turbulent, 0.5), atol=1e-4)
    assert float(sample.voxels.abs().max()) == 0


def test_sub_frame_samples_refine_the_same_windows():
    fine = pipeline(scene=Waves(frames=9), substeps=2)
    sample = simulate(fine, [0])
    assert sample.voxels.shape[1] == sample.target.shape[1] == 4
    assert sample.window_s.tolist() == [pytest.approx(1 / 60)]
    assert torch.equal(sample.target[0, :, 0], Waves(frames=9).clip(0).frames[2::2])


def test_what_was_drawn_is_recorded():
    drawn = simulate(pipeline(STRONG, sensor={"threshold": [0.1, 0.7]}), [0]).parameters[0]
    assert 4 <= drawn["d_over_r0"] < 10 and 0.1 <= drawn["threshold"] <= 0.7
    assert drawn["source"] == "", "a scene of no photograph"
    assert drawn["tilt_px"] > 0 and math.isfinite(drawn["tilt_px"])


def test_finite_clips_come_again_with_other_crops():
    chain = pipeline(STRONG, crop=16, random_crop=True, clips=3)
    first, again = chain.draw(1), chain.draw(4)
    assert first.key == again.key and first.crop != again.crop


@pytest.mark.parametrize("split, differ", [("train", True), ("val", False), ("test", False)])
def test_hot_pixels_lie_elsewhere_in_every_training_clip(split, differ):
    hot = {"threshold": 0.2, "hot_pixel_fraction": 0.1, "hot_pixel_hz": 100.0}
    dark = Waves(contrast=0.0)
    chain = pipeline(sensor=hot, optics=Optics(1), scene=dark, split=split)
    first, second, again = (simulate(chain, [number]).voxels != 0 for number in (0, 1, 0))
    places = first.flatten(0, 3).any(0), second.flatten(0, 3).any(0)
    assert torch.equal(first, again) and places[0].sum() > 50
    shared = float((places[0] & places[1]).sum() / places[0].sum())
    assert shared < 0.4 if differ else shared > 0.6


@pytest.mark.parametrize("crop", [0, 4, 49, 1.5])
def test_a_crop_that_does_not_fit_names_its_key(crop):
    with pytest.raises(ValueError, match="data.crop"):
        pipeline(crop=crop).draw(0)


@pytest.mark.parametrize("source", ["linear", "srgb"])
def test_turbulent_frames_are_code_values_as_the_target(source):
    sample = simulate(pipeline(sensor=IDEAL | {"input": source}), [0])
    torch.testing.assert_close(sample.turbulent, sample.target)


class Lamplit(Waves):
    """The waves under a lamp that dims by 40 % every second frame; in the left half if `half`."""

    def __init__(self, half: bool, **kwargs):
        super().__init__(**kwargs)
        self.half = half

    def clip(self, index: int) -> Clip:
        lamp = torch.ones(self.frames, 1, self.side if self.half else 1)
        lamp[1::2, :, : self.side // 2] = 0.6
        return replace(super().clip(index), illumination=lamp)


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("crop", [None, 24])
def test_a_lamp_flickers_in_the_light_and_not_in_the_truth(half, crop):
    plain = simulate(pipeline(scene=Waves(contrast=0.05), crop=crop), [2])
    lit = simulate(pipeline(scene=Lamplit(half, contrast=0.05), crop=crop), [2])
    assert torch.equal(plain.target, lit.target)
    dimmed = lit.turbulent / plain.turbulent
    side = dimmed.shape[-1] // 2 if half else dimmed.shape[-1]
    assert torch.allclose(dimmed[:, ::2, ..., :side], torch.tensor(0.6))
    assert torch.allclose(dimmed[:, 1::2], torch.tensor(1.0))
    assert torch.equal(lit.voxels[..., side:], plain.voxels[..., side:])
    assert (lit.voxels[:, 0, ..., :side].sum(2) <= -1).all()  # 0.51 nat down, a threshold of 0.2


def test_a_clip_is_recorded_with_the_temporal_model_that_it_is_simulated_with():
    mixed, *single = (
        pipeline(SimulatedTurbulence({"severity": "weak"}, temporal_model=model), optics=Optics(1))
        for model in ("mixed", "ar1", "frozen_flow")
    )
    samples = [simulate(chain, range(6)) for chain in (mixed, *single)]
    models = set()
    for ours, *others in zip(*(sample.parameters for sample in samples), strict=True):
        model, at = ours["temporal_model"], ours["clip"]
        models.add(model)
        seen, *own = (sample.voxels[at] for sample in samples)
        assert torch.equal(seen, own[model == "frozen_flow"])
        assert not torch.equal(seen, own[model == "ar1"])
        assert ours == others[model == "frozen_flow"]
        assert (ours["wind_m_s"] == 0) == (model == "ar1")
    assert models == {"ar1", "frozen_flow"}
