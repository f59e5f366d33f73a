"""The how-to page for notebooks, cell by cell in a real kernel."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path

import pytest

from tests.cli.fake_skin import fake_process

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "asyncio.md"
NOTHING_LEFT = 'assert "skinware wake-ups" not in [t.name for t in __import__("threading").enumerate()]'


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")  # of the packages that run notebooks
def test_the_page_runs_in_a_kernel(tmp_path: Path) -> None:
    import nbclient
    from nbformat import from_dict

    cells = [*re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL), NOTHING_LEFT]
    notebook = from_dict(  # type: ignore[no-untyped-call]
        {
            "nbformat": 4,
            "nbformat_minor": 4,
            "metadata": {},
            "cells": [
                {"cell_type": "code", "metadata": {}, "source": cell, "outputs": [], "execution_count": None}
                for cell in cells
            ],
        }
    )
    with fake_process("arm"):
        place = {"metadata": {"path": str(tmp_path)}}
        client = nbclient.NotebookClient(notebook, timeout=100, kernel_name="python3", resources=place)
        asyncio.run(client.async_execute())
    outputs = [output for cell in notebook.cells for output in cell["outputs"]]
    assert outputs[0]["data"]["text/plain"] == "(640,)"
    printed = "".join(output.get("text", "") for output in outputs)
    assert re.search(r"hardest \d+ in \d+ looks", printed)
    assert "sensors: 768" in printed
