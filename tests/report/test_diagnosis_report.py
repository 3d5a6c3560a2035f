from types import SimpleNamespace

import pytest

from bayessim_jax.report import html
from bayessim_jax.report.diagnose import _bent


def warnings(before, after, names_something=True):
    diagnosis = SimpleNamespace(result=SimpleNamespace(names_something=names_something))
    entry = {"baseline": dict(zip(("mean", "sd"), before, strict=True))}
    entry["augmented"] = dict(zip(("mean", "sd"), after, strict=True))
    return _bent(diagnosis, {"parameters": {"<mass>": entry}})


@pytest.mark.parametrize(
    ("before", "after", "told"),
    [
        ((0.497, 0.034), (0.4066, 0.0003), "22 % off"),
        ((0.51, 0.08), (0.4066, 0.0003), "25 % off"),  # a wide interval, but far
        ((0.415, 0.003), (0.4066, 0.0003), "2.1 % off"),  # not far, but sure
        ((0.415, 0.006), (0.4066, 0.0003), None),  # neither
        ((0.6, 0.3), (0.4, 0.1), None),  # nothing is known of it
        ((0.3, 0.1), (0.0, 0.1), "out off"),  # no share of nothing
    ],
)
def test_a_parameter_that_took_the_place_of_what_was_missing_is_told(before, after, told):
    found = warnings(before, after)
    assert [told in each and "&lt;mass&gt;" in each for each in found] == ([True] if told else [])
    assert warnings(before, after, names_something=False) == []


def test_what_was_found_in_a_case_is_folded_and_escaped():
    assert html.findings([]) == ""
    shown = html.findings(["warning: <run>.csv: joint/hinge/qvel is 5 ms later than joint/hinge/qpos"])
    assert "<details" in shown and "&lt;run&gt;.csv" in shown and "<run>" not in shown
