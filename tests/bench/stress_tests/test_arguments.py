"""Arguments that stress tests cannot run with, those of the shipped configs, and titles."""

import pytest
from omegaconf import OmegaConf

from src.bench.stress_tests.arguments import check_arguments, fill_title
from tests.conftest import ROOT

KEY = "stress_tests.any.test"


def check(function: str, **given) -> None:
    check_arguments(KEY, function, given, fps=120.0)


@pytest.mark.parametrize(
    ("function", "given", "said"),
    [
        ("measure_contrast_retention_percent", {"windows": []}, "windows must be rising whole"),
        ("measure_contrast_retention_percent", {"windows": [9, 3]}, "windows must be rising whole"),
        ("measure_bf16_psnr_difference", {"windows": 3}, "windows must be a whole number >= 4"),
        ("measure_long_sequence_drift", {"windows": [9]}, "windows must be a whole number >= 1"),
        ("any", {"values": []}, "values must be one or more"),
        ("any", {"sizes": []}, "sizes must be one or more"),
        ("any", {"draws": 0}, "draws must be a whole number >= 1"),
        ("any", {"steps": 0}, "steps must be a whole number >= 1"),
        ("any", {"counts": []}, "counts must be whole numbers >= 1"),
        ("any", {"counts": [0]}, "counts must be whole numbers >= 1"),
        ("any", {"kept_shares": []}, r"kept_shares must be in \(0, 1\]"),
        ("any", {"kept_shares": ["all"]}, r"kept_shares must be in \(0, 1\]"),
        ("any", {"rates_hz": []}, "rates_hz must be such that they and fps=120 are multiples"),
        ("any", {"rates_hz": [100]}, "rates_hz must be such that they and fps=120 are multiples"),
        ("any", {"rates_hz": [60, 0]}, "rates_hz must be such that they and fps=120 are multiples"),
        ("any", {"shifts_px": [1, 4], "judged_shift_px": 2}, "judged_shift_px must be one of"),
        ("any", {"parameter": "foo"}, "parameter must be of d_over_r0, .*, sensor.threshold, "),
        ("any", {"parameter": "sensor.foo"}, "parameter must be of d_over_r0"),
        ("any", {"fixed": {"turbulence.foo": 1}}, "fixed must be of .*, turbulence.wind_m_s"),
    ],
)
def test_what_a_test_cannot_run_with_is_refused(function, given, said):
    got = next(iter(given.values())) if "judged_shift_px" not in given else 2
    with pytest.raises(ValueError, match=rf"^stress_tests\.any\.test\.{said}") as error:
        check(function, **given)
    assert str(error.value).endswith(f", got {got}")


def test_the_shipped_tests_are_allowed():
    for file in (ROOT / "conf" / "stress_tests").glob("*.yaml"):
        for node in OmegaConf.load(file).values():
            given = dict(node.test)
            check(given.pop("_target_").rpartition(".")[2], **given)
    check("any", rates_hz=[40, 6400], counts=[8], parameter="turbulence.baseline_m", fixed=None)


def test_a_title_has_the_arguments_of_its_test():
    given = {"windows": 500, "values": [30.0, 0.5, 10], "sizes": [[2, 3]], "none": []}
    title = fill_title(
        "", "{windows:,} and {values.least:g} to {values.most:g}, {values.last}", given
    )
    assert title == "500 and 0.5 to 30, 10"


@pytest.mark.parametrize("title", ["{foo}", "{windows.most}", "{windows", "{}", "{sizes.most}"])
def test_a_title_that_names_no_argument_is_refused(title):
    given = {"windows": 500, "sizes": [[2, 3]]}
    with pytest.raises(
        ValueError, match=r"^stress_tests\.a\.title must name .* windows, sizes, got"
    ):
        fill_title("stress_tests.a.title", title, given)
