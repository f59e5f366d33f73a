"""Tutorials are followed to the letter, from an empty folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.outside.stranger import Stranger
from tests.outside.walkthrough import Walkthrough, steps
from tests.wheel import ROOT

PAGES = ["docs/tutorials/first-can-driver.md", "docs/tutorials/first-serial-driver.md"]


@pytest.mark.thorough
@pytest.mark.timeout(400)
@pytest.mark.parametrize("page", PAGES)
def test_a_tutorial_leads_to_what_it_promises(stranger: Stranger, page: str, tmp_path: Path) -> None:
    assert Walkthrough(tmp_path, stranger.environ).follow((ROOT / page).read_text()) > 15


ENDS_BADLY = """<!-- terminal -->
```console
trap 'exit 3' INT
touch f
while :; do sleep 0.01; done
```
```console
until [ -e f ]; do sleep 0.01; done
```
"""


def walk(tmp_path: Path, page: str) -> None:
    Walkthrough(tmp_path, {"PATH": "/usr/bin:/bin"}).follow(page)


def test_every_kind_of_step_is_followed(tmp_path: Path) -> None:
    page = """
<!-- terminal -->
```console
touch ready
exec sleep 1000
```
<!-- terminal, once there is ready -->
```console
rm ready
```
```console
mkdir new && cd new
echo one > numbers
```
```console
echo two >> numbers
cat numbers; echo "3 s"
```
```text
one
... s
```
<!-- edit: numbers -->
```diff
 one
-two
+three
```
<!-- part of: numbers -->
```python
one
three
```
<!-- fails -->
```console
grep two numbers
```
<!-- close terminals -->
<!-- write: more -->
```toml
a = 1
```
"""
    assert [step.kind for step in steps(page)].count("console") == 5
    walk(tmp_path, page)
    assert (tmp_path / "new/numbers").read_text() == "one\nthree\n"
    assert (tmp_path / "new/more").read_text() == "a = 1\n"


@pytest.mark.parametrize(
    ("page", "words"),
    [
        ("```console\nfalse\n```\n", "line 1: status 1"),
        ("<!-- fails -->\n```console\ntrue\n```\n", "line 1: status 0"),
        ("```console\necho a; echo b\n```\n```text\nb\na\n```\n", "line 6: 'a' was not printed"),
        ("```console\necho a > f\n```\n<!-- edit: f -->\n```diff\n-b\n+c\n```\n", "line 4: 0 times in f"),
        ("```console\necho a > f\n```\n<!-- part of: f -->\n```python\nb\n```\n", "line 4: not in f"),
        ("```python\nb\n```\n", "line 1: what is to be done"),
        (ENDS_BADLY, "line 1: trap"),
    ],
)
def test_what_does_not_hold_is_found(page: str, words: str, tmp_path: Path) -> None:
    with pytest.raises((AssertionError, ProcessLookupError), match=words):
        walk(tmp_path, page)
