"""The directive ``commands``: the options of every command, as ``--help`` shows them."""

from __future__ import annotations

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from skinware_drivers.cli import skin


class Commands(SphinxDirective):
    """Show all commands."""

    def run(self) -> list[nodes.Node]:
        lines = []
        for name, tool in skin.COMMANDS.items():
            lines += [f"```{{click}} {tool.module}:command", f":prog: skin-{name}", ":nested: full", "```", ""]
        found = nodes.container()
        self.state.nested_parse(StringList(lines, source=self.get_source_info()[0]), self.content_offset, found)
        return found.children


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("commands", Commands)
    return {"parallel_read_safe": True}
