"""Fail if the package that runs here is not an installed one, with its libraries."""

from __future__ import annotations

from pathlib import Path

import skinware
import skinware_drivers
from skinware_drivers import native

package = Path(skinware.__file__).parent
native.library()
print(package)
assert package.parent == Path(skinware_drivers.__file__).parent.parent
assert not (package.parent / "pyproject.toml").exists()
