"""The directive ``driver-options NAME``: a table of a driver's options, from the class that declares them."""

from __future__ import annotations

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from skinware_drivers.options import describe_options
from skinware_drivers.registry import load_driver


class DriverOptions(SphinxDirective):
    """Show the options that ``skin-driver --driver NAME --help`` lists."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        rows = ["| option | values | meaning | default |", "|---|---|---|---|"]
        for option in describe_options(load_driver(self.arguments[0]).Options):
            values = option.kind.replace("|", ", ")
            rows.append(f"| `{option.name}` | {values} | {option.description} | {option.default} |")
        found = nodes.container()
        self.state.nested_parse(StringList(rows, source=self.get_source_info()[0]), self.content_offset, found)
        return found.children


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("driver-options", DriverOptions)
    return {"parallel_read_safe": True}
