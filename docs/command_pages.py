"""The directive ``commands``: the options of every command, as ``--help`` shows them."""

from __future__ import annotations

from importlib.metadata import entry_points

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective


class Commands(SphinxDirective):
    """Show all commands."""

    def run(self) -> list[nodes.Node]:
        lines = []
        for entry in entry_points(group="console_scripts"):
            if entry.name.startswith("skin-"):
                lines += [f"```{{click}} {entry.module}:command", f":prog: {entry.name}", ":nested: full", "```", ""]
        found = nodes.container()
        self.state.nested_parse(StringList(lines, source=self.get_source_info()[0]), self.content_offset, found)
        return found.children


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("commands", Commands)
    return {"parallel_read_safe": True}
