"""BrainCo's own program (bc-revo3-sdk) at emulated Revo3 hands."""

from __future__ import annotations

import asyncio
import sys
from importlib import import_module
from typing import Any

from brainco import Comparison, at_a_port

from skinware_drivers.virtual.devices.registers import EmulatedRevo3

_POINTS = [36, 31, 57, 21, 52, 21, 52, 21, 52, 21, 52]
_MATRIX = [53, 56, 22, 22, 27, 22, 27, 22, 27, 22, 27]
_ZONES = [1, 3, 6, 3, 5, 3, 5, 3, 5, 3, 5]


def _split(values: list[int], counts: list[int]) -> list[list[int]]:
    rest = iter(values)
    return [[next(rest) for _ in range(count)] for count in counts]


async def _touch_of(sdk: Any, manager: Any, port: str) -> Any:
    found = await manager.discover(
        port=port, protocol=sdk.ProtocolType.Modbus, slave_id=1, modbus_baudrate=sdk.Rs485Baudrate.Baud5Mbps
    )
    hand = await manager.connect(found[0])
    return hand, hand.touch


async def _taxels(sdk: Any, port: str, compare: Comparison, values: list[int]) -> None:
    async with sdk.Manager() as manager:
        hand, touch = await _touch_of(sdk, manager, port)
        compare.agree("model", sdk.Revo3Model.UltraTouch, hand.device_info.model)
        compare.agree("side", sdk.HandSide.Right, hand.device_info.hand_side)
        compare.agree("counts", _POINTS, await touch.point_counts())
        compare.agree("taxels or sums", sdk.TouchReadMode.PointArray, await touch.read_mode())
        compare.agree("kind of values", sdk.TouchValueMode.Force, await touch.value_mode())
        frame = await touch.snapshot()
        compare.agree("taxels", _split(values, _POINTS), [module.points for module in frame.modules])
        await touch.tare()


async def _sums(sdk: Any, port: str, compare: Comparison, values: list[int]) -> None:
    async with sdk.Manager() as manager:
        _, touch = await _touch_of(sdk, manager, port)
        compare.agree("taxels or sums", sdk.TouchReadMode.LegacyForceSummary, await touch.read_mode())
        frame = await touch.snapshot()
        compare.agree("sums", _split(values, _ZONES), [module.regional_forces_mn for module in frame.modules])


async def _packed(sdk: Any, port: str, compare: Comparison, values: list[int]) -> None:
    async with sdk.Manager() as manager:
        _, touch = await _touch_of(sdk, manager, port)
        compare.agree("counts", _MATRIX, await touch.point_counts())
        frame = await touch.snapshot()
        in_mn = _split([10 * value for value in values], _MATRIX)
        in_mn[2] = [value // 10 for value in in_mn[2]]  # of which it sends counts
        compare.agree("taxels", in_mn, [module.points for module in frame.modules])


_EXCHANGES: tuple[tuple[Any, list[int], dict[str, Any]], ...] = (
    (_taxels, list(range(1, 417)), {"values": "force"}),
    (_sums, list(range(1, 43)), {"sums": True}),
    (_packed, [place % 256 for place in range(327)], {"mapping": "packed", "values": "force", "adc_pads": (2,)}),
)


def main() -> int:
    """Compare, and give the exit status: 1 if anything differs."""
    sdk = import_module("bc_revo3_sdk.main_mod")
    sdk.init_logging(sdk.LogLevel.Error, False)
    compare = Comparison("bc-revo3-sdk")
    for exchange, values, options in _EXCHANGES:
        with at_a_port(EmulatedRevo3, values, **options) as port:
            asyncio.run(exchange(sdk, port, compare, values))
    return int(compare.differs)


if __name__ == "__main__":
    sys.exit(main())
