"""Says what is installed; fails if it is not the native data path of an installed package."""

from __future__ import annotations

import sys
from pathlib import Path

import skinware
import skinware_drivers
from skinware import native as core
from skinware_drivers import native as drivers

package = Path(skinware.__file__).parent
paths = {"skinware": core.why_python() or "native", "skinware_drivers": drivers.why_python() or "native"}
print(f"{package}: {paths}")
assert package.parent == Path(skinware_drivers.__file__).parent.parent
assert not (package.parent / "pyproject.toml").exists()
sys.exit(set(paths.values()) != {"native"})
