"""Terms of the training loss: what each costs, and the terms of a config."""

import pytest
import torch

from src.app import build
from src.losses.terms import (
    STATIC_CHANGE,
    Distillation,
    FrameTerm,
    L1Term,
    LPIPSTerm,
    SequenceTerm,
    SSIMTerm,
    StaticFlicker,
    TemporalConsistency,
    TrainingLoss,
)
from tests.test_train import config

ALL = torch.tensor([True, True])
CONSISTENCY, FLICKER = TemporalConsistency(), StaticFlicker()


def frames(seed: int = 0) -> torch.Tensor:
    return torch.rand(2, 3, 1, 16, 16, generator=torch.Generator().manual_seed(seed))


def test_consistency_is_of_the_error_and_static_flicker_of_the_frame():
    moving = frames()
    assert CONSISTENCY(moving, moving, ALL) == 0  # a frame that is right may move ...
    assert FLICKER(moving, moving, ALL) < 1e-4  # ... where the truth does
    static = moving[:, :1].expand_as(moving)
    assert CONSISTENCY(moving, static, ALL) > 0.1 and FLICKER(moving, static, ALL) > 0.1
    assert FLICKER(static, moving, ALL) == 0


def test_a_fainter_frame_flickers_as_much():
    seen, static = frames(), torch.zeros(2, 3, 1, 16, 16)
    whole, faint = FLICKER(seen, static, ALL), FLICKER(0.5 * seen, static, ALL)
    assert abs(faint / whole - 1) < 0.02
    assert CONSISTENCY(0.5 * seen, static, ALL) < 0.51 * CONSISTENCY(seen, static, ALL)


def test_only_static_places_and_consecutive_windows_count():
    seen, truth = frames(), torch.zeros(2, 3, 1, 16, 16)
    truth[:, 1:, :, :, 8:] = 2 * STATIC_CHANGE
    truth[:, 2:, :, :, 8:] = 0
    still = seen.clone()
    still[..., :8] = seen[:, :1, ..., :8]
    assert FLICKER(seen, truth, ALL) > 0 and FLICKER(still, truth, ALL) == 0
    first, zeros = torch.tensor([True, False]), torch.zeros_like(seen)
    still = torch.cat([seen[:, :1], seen[:, :1], seen[:, 2:]], 1)
    assert FLICKER(still, zeros, first) == 0 and FLICKER(still, zeros, ALL) > 0


def test_the_gradient_of_static_flicker_asks_for_no_less_contrast():
    seen, static = frames().requires_grad_(), torch.zeros(2, 3, 1, 16, 16)
    FLICKER(seen, static, ALL).backward()
    along = (seen.grad * seen).sum((-2, -1))  # what scaling all windows alike would change
    assert along.sum().abs() < 0.1 * (seen.grad * seen).abs().sum()
    flat = torch.full((2, 3, 1, 16, 16), 0.5).requires_grad_()
    FLICKER(flat, static, ALL).backward()
    assert flat.grad.isfinite().all()


def test_l1_is_not_clipped():
    assert float(L1Term()(torch.full((1, 1, 4, 4), 2.0), torch.ones(1, 1, 4, 4))) == 1.0


def total(seen, truth, teachers=None, **weights):
    kinds = {"l1": L1Term, "ssim": SSIMTerm, "consistency": TemporalConsistency}
    kinds |= {"flicker": StaticFlicker, "distillation": Distillation, "lpips": LPIPSTerm}
    loss = TrainingLoss({name: kinds[name](weight) for name, weight in weights.items()})
    return loss.value_and_gradient(seen, truth, [2, 3, 7], teacher_frames=teachers)


def test_value_and_gradient_are_those_of_the_weighted_sum(monkeypatch):
    monkeypatch.setattr("src.losses.terms.FRAMES_AT_A_TIME", {"cpu": 4})
    seen, truth, teachers = frames(0), frames(1), frames(2)
    truth[:, 1] = truth[:, 0]
    weights = {"l1": 2.0, "ssim": 0.5, "consistency": 3.0, "flicker": 0.7, "distillation": 1.5}
    value, gradient = total(seen, truth, teachers, **weights)
    leaf, first = seen.clone().requires_grad_(), torch.tensor([True, False])

    def compare(target):
        pair = leaf.flatten(0, 1), target.flatten(0, 1)
        return (2 * L1Term()(*pair) + 0.5 * SSIMTerm()(*pair)).mean()

    by_hand = compare(truth) + 1.5 * compare(teachers)
    by_hand = by_hand + 3 * CONSISTENCY(leaf, truth, first) + 0.7 * FLICKER(leaf, truth, first)
    by_hand.backward()
    torch.testing.assert_close(value, by_hand.detach())
    torch.testing.assert_close(gradient, leaf.grad)


def test_the_sum_of_all_terms_is_that_of_the_trainings_shipped():
    generator = torch.Generator().manual_seed(7)
    seen, truth, teachers = torch.rand(3, 2, 4, 1, 40, 40, generator=generator)
    truth[:, 1:3] = truth[:, :1]
    terms = {
        "l1": L1Term(0.33), "ssim": SSIMTerm(0.33), "lpips": LPIPSTerm(1.0),
        "consistency": TemporalConsistency(1.3), "flicker": StaticFlicker(0.7),
        "distillation": Distillation(0.8),
    }  # fmt: skip
    value, gradient = TrainingLoss(terms).value_and_gradient(
        seen, truth, [4, 5, 6, 9], teacher_frames=teachers
    )
    assert float(value) == pytest.approx(2.1013882, rel=1e-6)
    assert float(gradient.double().abs().sum()) == pytest.approx(6.145152199, rel=1e-5)


def test_teachers_are_compared_without_lpips_unless_there_is_nothing_else():
    seen = torch.rand(1, 3, 1, 32, 32, generator=torch.Generator().manual_seed(0))
    teachers = 1 - seen
    plain = total(seen, seen, None, l1=1.0, lpips=1.0)[0]
    taught = total(seen, seen, teachers, l1=1.0, lpips=1.0, distillation=2.0)[0]
    torch.testing.assert_close(taught - plain, 2 * (seen - teachers).abs().mean())
    alone = total(seen, seen, teachers, lpips=1.0, distillation=2.0)[0]
    assert alone > 0.1


class Charbonnier(FrameTerm):
    """A term of one's own."""

    def forward(self, frames, target):
        return ((frames - target).square() + 1e-6).sqrt().mean((1, 2, 3))


def test_a_config_takes_a_term_of_one_s_own(tmp_path):
    own = "+loss.own={_target_: tests.losses.test_terms.Charbonnier, weight: 0.5}"
    cfg = config("train", tmp_path, "loss=l1", "allowed_packages=[tests]", own)
    loss = build.build_loss(cfg)
    assert list(loss.terms) == ["l1", "distillation", "own"]
    assert loss.terms["own"].weight == 0.5
    zeros, ones = torch.zeros(1, 1, 8, 8), torch.ones(1, 1, 8, 8)
    assert float(loss(ones, zeros)) == pytest.approx(1.5, abs=1e-5)


class PerClip(SequenceTerm):
    """A term that forgets to average over clips."""

    def forward(self, frames, target, is_consecutive):
        return (frames - target).abs().mean((1, 2, 3, 4))


def test_a_sequence_term_has_one_value():
    seen, truth = (torch.rand(2, 3, 1, 8, 8) for _ in range(2))
    loss = TrainingLoss({"l1": L1Term(), "own": PerClip()})
    with pytest.raises(ValueError, match=r"PerClip must return one value, .*, got shape \(2,\)"):
        loss.value_and_gradient(seen, truth, [0, 1, 2])


class Learned(Charbonnier):
    """A term with a parameter."""

    def __init__(self, weight: float = 1.0):
        super().__init__(weight)
        self.scale = torch.nn.Parameter(torch.ones(()))


def test_a_term_with_parameters_to_train_is_refused():
    with pytest.raises(ValueError, match="loss.own must have no parameters to train"):
        TrainingLoss({"own": Learned()})
    assert TrainingLoss({"own": Learned().requires_grad_(False)}).frame_terms


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["loss.l1.weight=-1"], "loss.l1.weight must be >= 0, got -1"),
        (["loss.static_flicker.weight=.inf"], "loss.static_flicker.weight must be >= 0"),
        (["loss.l1=1"], r"loss.l1 must be a term \(loss.l1.weight=...\), got 1"),
        (["loss.l1.weight=0"], "loss must have a frame term of weight > 0"),
        (["+loss.x={_target_: src.models.e2vid.E2VID}"], "loss.x._target_ must be a FrameTerm"),
        (
            ["loss.distillation.weight=1.5"],
            "loss.distillation.weight must be 0 or 1 without teachers",
        ),
        (
            ["teachers=lf3x3", "loss.distillation.weight=0"],
            "loss.distillation.weight must be > 0 with teachers, got 0",
        ),
    ],
)
def test_wrong_terms_are_one_line(overrides, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        build.build_loss(config("train", tmp_path, "loss=l1", *overrides))
