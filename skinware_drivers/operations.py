"""What user programs may ask a driver to do: methods of its adapter, or of its bus, that are marked as operations."""

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
        sets_up: it sets its patches up anew: doubts about their values end.
        looks: it only looks and changes nothing.
        alone: it is for ``skin-config`` on a bus without a running driver, which would not know what happened.
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
    called once per bus, with the patches on it that are meant: all, unless the program says ``bus=`` or ``patch=``
    (their names). What it returns must be something that JSON can hold; what it raises is told to the program.

    Args:
        sets_up: it sets its patches up anew: doubts about their values end.
        looks: it changes nothing, so nobody need be asked first, and patches need not be known.
        alone: a running driver does not offer it; ``skin-config`` does, on a bus without one.
    """

    def mark(method: OperationT) -> OperationT:
        setattr(method, _MARK, Operation(method, sets_up, looks, alone))
        return method

    return mark


def operations_of(adapter: type[Any], *, alone: bool = False) -> dict[str, Operation]:
    """The operations of an adapter class by name, sorted.

    Args:
        adapter: the class.
        alone: also those that a running driver does not offer.
    """
    members = inspect.getmembers(adapter, inspect.iscoroutinefunction)
    found: dict[str, Operation] = {name: getattr(member, _MARK) for name, member in members if hasattr(member, _MARK)}
    return {name: declared for name, declared in found.items() if alone or not declared.alone}


def check_arguments(method: Callable[..., Any], arguments: dict[str, Any]) -> None:
    """Whether a method of an adapter takes these arguments beside the link and the patches.

    Raises:
        TypeError: it does not; the message says what it takes.
    """
    parameters = list(inspect.signature(method).parameters.values())[_OWN_PARAMETERS:]
    try:
        inspect.Signature(parameters).bind(**arguments)
    except TypeError as error:
        takes = ", ".join(["bus", "patch", *map(str, parameters)])
        raise TypeError(f"{error}; it takes: {takes}") from None
