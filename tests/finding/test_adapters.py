"""python-can's search for adapters, in a process that may misbehave."""

from __future__ import annotations

import sys

import pytest

from skinware_drivers.finding.interfaces import CanAdapterFound, detect_adapters


def script(text: str) -> list[str]:
    tell = "tell = lambda a, c=(): print(json.dumps(dict(asked=a, configs=c)), flush=True)"
    return [sys.executable, "-c", f"import json, os, time\n{tell}\n{text}"]


def test_adapters_become_names_of_buses() -> None:
    found = detect_adapters(
        30,
        script("tell('kvaser', [{'interface': 'kvaser', 'channel': 0, 'name': 'Leaf'}])\nprint('noise')\ntell(None)"),
    )
    assert found.found == [CanAdapterFound("kvaser:0", {"name": "Leaf"})]
    assert found.problem == ""


def test_a_library_that_crashes_is_named_and_the_rest_kept() -> None:
    found = detect_adapters(30, script("tell('kvaser', [{'channel': 1}])\ntell('pcan')\nos.abort()"))
    assert found.found == [CanAdapterFound("kvaser:1")]
    assert "'pcan' ended the search" in found.problem


def test_a_library_that_hangs_is_ended_and_told() -> None:
    found = detect_adapters(1.0, script("tell('ixxat')\ntime.sleep(1000)"))
    assert found.found == []
    assert "did not answer within 1 s" in found.problem


@pytest.mark.thorough
def test_the_real_search_comes_to_its_end() -> None:
    assert detect_adapters(60).problem == ""
