"""Operations that programs may call: methods of a driver's adapter, or of its bus, that are marked as such."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

OperationT = TypeVar("OperationT", bound=Callable[..., Any])

_MARK = "__skinware_operation__"
_OWN_PARAMETERS = 3  # self, link, patches


@dataclass(frozen=True)
class Operation:
    """One operation of an adapter class.

    Attributes:
        method: coroutine function (adapter, link, patches, ...).
        sets_up: it sets its patches up again, so that doubts about their values end.
        looks: it changes nothing.
        alone: it is only for ``skin-config`` on a bus without a running driver.
    """

    method: Callable[..., Any]
    sets_up: bool = False
    looks: bool = False
    alone: bool = False


def operation(*, sets_up: bool = False, looks: bool = False, alone: bool = False) -> Callable[[OperationT], OperationT]:
    """Mark an adapter's coroutine method as an operation, under its own name.

    ::

        @operation()
        async def tare(self, link: Link, patches: Sequence[Patch], samples: int = 10) -> None:
            \"\"\"Take the present values as zero.\"\"\"

    Programs call it with ``reader.call("tare", samples=20)``; the docstring's first line describes it to them. It is
    called once per bus, with the patches that are meant: all of the bus, or those that ``bus=`` and ``patch=`` name.
    Its result must be something that JSON can hold; the program gets its result, or the error that it raises.

    Args:
        sets_up: it sets its patches up again, so that doubts about their values end.
        looks: it changes nothing, so that no confirmation is needed, and no known patch.
        alone: a running driver does not offer it; ``skin-config`` does, on a bus without one.
    """

    def mark(method: OperationT) -> OperationT:
        setattr(method, _MARK, Operation(method, sets_up, looks, alone))
        return method

    return mark


def operations_of(adapter: type[Any], *, alone: bool = False) -> dict[str, Operation]:
    """Return the operations of an adapter class by name, sorted.

    Args:
        alone: also those that a running driver does not offer.
    """
    members = inspect.getmembers(adapter, inspect.iscoroutinefunction)
    found: dict[str, Operation] = {name: getattr(member, _MARK) for name, member in members if hasattr(member, _MARK)}
    return {name: declared for name, declared in found.items() if alone or not declared.alone}


def check_arguments(method: Callable[..., Any], arguments: dict[str, Any]) -> None:
    """Check that a method of an adapter takes these arguments beside the link and the patches.

    Raises:
        TypeError: it does not; the message has the arguments that it takes.
    """
    parameters = list(inspect.signature(method).parameters.values())[_OWN_PARAMETERS:]
    try:
        inspect.Signature(parameters).bind(**arguments)
    except TypeError as error:
        takes = ", ".join(["bus", "patch", *map(str, parameters)])
        raise TypeError(f"{error}; it takes: {takes}") from None
