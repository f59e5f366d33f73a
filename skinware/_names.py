"""Names of patches, modules and sensors as people know them: ``board 8``, ``board 8, triangle 3, taxel 5``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

_BY_TYPE = ("temperature", "acceleration", "angular_rate")
"""Sensors of these types are called by their type; all others are taxels."""


def distinct(names: Sequence[str], owners: Sequence[str], how: str) -> tuple[str, ...]:
    """Return the names; where several things have one name, with what they belong to: ``board 8 on can0``."""
    count = Counter(names)
    pairs = zip(names, owners, strict=True)
    return tuple(f"{name} {how} {owner}" if count[name] > 1 else name for name, owner in pairs)


def module_names(
    own_names: Sequence[str], kinds: Sequence[str], patches: Sequence[int], names_of_patches: Sequence[str]
) -> tuple[str, ...]:
    """Return the names of all modules, each after that of its patch.

    One without a name of its own has its kind and, among several of that kind in its patch, a number from 0; the only
    module of a patch is called as the patch.
    """
    pairs = zip(patches, names_in_patches(own_names, kinds, patches), strict=True)
    return tuple(joined(names_of_patches[patch], name) for patch, name in pairs)


def names_in_patches(own_names: Sequence[str], kinds: Sequence[str], patches: Sequence[int]) -> tuple[str, ...]:
    """Return what ``module_names`` adds to the names of the patches; empty where it adds nothing."""
    in_patch = Counter(patches)
    of_kind = Counter(zip(patches, kinds, strict=True))
    seen: Counter[tuple[int, str]] = Counter()
    names = []
    for own, kind, patch in zip(own_names, kinds, patches, strict=True):
        number = seen[patch, kind]
        seen[patch, kind] += 1
        if not own and in_patch[patch] > 1:
            own = kind or "module"
            own = f"{own} {number}" if of_kind[patch, kind] > 1 else own
        names.append(own)
    return tuple(names)


def name_in_module(type_name: str, number: int, is_only: bool) -> str:
    """Return a sensor's name in its module, by its number from the lowest; empty: that of the module says all."""
    by_type = type_name.startswith(_BY_TYPE)
    if is_only:
        return type_name if by_type else ""
    return f"{type_name if by_type else 'taxel'} {number}"


def joined(owner: str, name: str) -> str:
    return f"{owner}, {name}" if name else owner
