"""``--region`` and ``--regions``: named parts of a skin, and the files that say what they are."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from skinware.errors import ConfigurationError

if TYPE_CHECKING:
    from skinware.tactile.regions import Regions

DEFAULT_REGIONS = "regions.toml"
"""File of regions where none is named, in the current folder."""

_Decorated = TypeVar("_Decorated", bound=Callable[..., Any])


def regions_option(command: _Decorated) -> _Decorated:
    return click.option(
        "--regions",
        "region_files",
        metavar="FILE",
        multiple=True,
        type=click.Path(path_type=Path),
        help=f"File with regions; repeat it for several.  [default with --region: {DEFAULT_REGIONS}]",
    )(command)


def regions_of(files: Sequence[Path], names: Collection[str] = ()) -> Regions:
    """The regions of files, or of the default one.

    Args:
        files: none: the default one.
        names: that have to be among them.

    Raises:
        ConfigurationError: a file cannot be read, or has no region of a name.
    """
    from skinware.tactile.regions import read_regions, unknown

    regions = read_regions(*(files or (DEFAULT_REGIONS,)))
    for why in unknown("region", names, [region.name for region in regions]):
        raise ConfigurationError(why)
    return regions


def regions_asked_for(names: Collection[str], files: Sequence[Path]) -> Regions:
    """The regions of files if some are named, else none.

    Raises:
        click.UsageError: there are files, and nothing is named.
        ConfigurationError: as :func:`regions_of`.
    """
    from skinware.tactile.regions import Regions

    if files and not names:
        raise click.UsageError("--regions says where regions are: say which with --region")
    return regions_of(files, names) if names else Regions(())
