"""Calibration by touch on the parts of an iCub: where taxels are put, and who is said to lie beside whom."""

from __future__ import annotations

import time

import numpy as np

from skinware.geometry import Geometry
from skinware.tactile.calibration.checking import MIRRORED, SWAPPED, Finding, check_strokes
from skinware.tactile.calibration.placing import place
from skinware.tactile.calibration.results import confidence_of
from skinware.tactile.calibration.topology import Topology, topology_of
from skinware.tactile.testing import Surface
from tests.tactile.calibrating import (
    DATA,
    PARTS,
    PITCH_M,
    geometry_of,
    judge,
    off_m,
    part,
    presses,
    shapes,
    stroked,
    true_ways_m,
)

EACH = 5
NOISES_M = (0.001, 0.002, 0.005)


def touches(seeds: int) -> None:
    """Mean error of places from presses, worst and typical seed, and what wrong presses cost."""
    print(f"{EACH} presses beside each taxel, {seeds} seeds: mean error, median seed (worst), mm;")
    print("  the same with 10 % wrong presses, as a part more (worst); said to be within half a pitch, and so")
    for name in PARTS:
        surface = part(name)
        for layout, known in (("alone", None), ("layout", shapes(surface))):
            for noise_m in NOISES_M:
                errors, costs, said, true = [], [], [], []
                for seed in range(seeds):
                    placement = place(presses(surface, seed, each=EACH, pose_noise_m=noise_m), known)
                    spoilt = place(presses(surface, seed, each=EACH, pose_noise_m=noise_m, wrong=0.1), known)
                    off, with_wrong = (np.nanmean(off_m(surface, p.position_m)) for p in (placement, spoilt))
                    errors.append(1e3 * off)
                    costs.append(100 * (with_wrong / off - 1))
                    said.append(confidence_of(placement.error_m[placement.known], PITCH_M))
                    true.append((off_m(surface, placement.position_m)[placement.known] < PITCH_M / 2).mean())
                text = f"{np.median(errors):.2f} ({max(errors):.2f})  +{np.median(costs):.0f} % ({max(costs):.0f} %)"
                print(f"  {name:<8} {layout:<7} noise {1e3 * noise_m:.0f} mm  {text}", end="")
                print(f"  {100 * np.mean(said):.0f} % / {100 * np.mean(true):.0f} %", flush=True)


def strokes(seeds: int) -> None:
    """How good topologies are, and what of swapped and mirrored modules is named."""
    for name in PARTS:
        surface = part(name)
        ways_m = true_ways_m(surface)
        for minutes in (1.0, 3.0):
            marks, took_s, named, alarms, tries = [], [], 0, 0, 0
            for seed in range(seeds):
                sums = stroked(surface, seed, minutes)
                begin = time.perf_counter()
                topology = topology_of(sums, PITCH_M)
                took_s.append(time.perf_counter() - begin)
                marks.append(judge(surface, topology, ways_m))
                found = exchanged(surface, topology, seed)
                named, alarms, tries = named + found[0], alarms + found[1], tries + 2
            pieces = sum(mark.pieces_right for mark in marks)
            low = {of: 100 * min(getattr(mark, of) for mark in marks) for of in ("precision", "recall", "covered")}
            geodesic = [100 * mark.geodesic for mark in marks]
            print(
                f"  {name:<8} {minutes:>4g} min: pieces right in {pieces} of {seeds}; least precision"
                f" {low['precision']:.1f} %, recall {low['recall']:.1f} %, covered {low['covered']:.1f} %; geodesic"
                f" error {np.median(geodesic):.1f} % (worst {max(geodesic):.1f} %); named {named} of {tries},"
                f" {alarms} false; {1e3 * np.median(took_s):.0f} ms",
                flush=True,
            )


def exchanged(surface: Surface, topology: Topology, seed: int) -> tuple[int, int]:
    """Swap two modules in a file, and in another mirror one: how many of the two are named; what else is found."""
    random = np.random.default_rng([seed, 11])
    whole = np.flatnonzero(np.bincount(surface.module) == 10)
    one, other = np.sort(random.choice(whole, 2, replace=False)).tolist()
    swapped, mirrored = geometry_of(surface), geometry_of(surface)
    first, second = surface.module == one, surface.module == other
    swapped.position_m[first], swapped.position_m[second] = surface.position_m[second], surface.position_m[first]
    places = surface.position_m[first] - surface.position_m[first].mean(axis=0)
    across = np.linalg.svd(places)[2][0]
    mirrored.position_m[first] -= 2 * (places @ across)[:, None] * across
    named, false = 0, len(found_in(geometry_of(surface), surface, topology))
    for geometry, wanted in ((swapped, (SWAPPED, (one, other))), (mirrored, (MIRRORED, (one,)))):
        found = [(finding.kind, finding.modules) for finding in found_in(geometry, surface, topology)]
        named += wanted in found
        false += len(found) - (wanted in found)
    return named, false


def found_in(geometry: Geometry, surface: Surface, topology: Topology) -> list[Finding]:
    """What is said to be wrong with a geometry."""
    return check_strokes(geometry, surface.module, surface.patch, topology)


def calibrate(seeds: int) -> None:
    """All of it."""
    if not DATA.is_dir():
        print(f"calibration: the positions of an iCub are not here: {DATA}")
        return
    touches(seeds)
    print(f"one finger strokes at 8 cm/s, {seeds} seeds; swapped and mirrored modules, one of each per seed")
    strokes(seeds)
