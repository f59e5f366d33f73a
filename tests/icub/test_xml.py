"""Reading XML that robots have, and XML that nobody should have."""

from __future__ import annotations

from pathlib import Path

import pytest

from skinware.errors import ConfigurationError
from skinware_drivers.icub.device import DeviceReader
from skinware_drivers.icub.xml_tree import LARGEST_FILE, Notes, read_xml
from tests.icub.conftest import Made, device

DOCTYPE = '<!DOCTYPE params PUBLIC "-//YARP//DTD yarprobotinterface 3.0//EN" "http://www.yarp.it/DTD/none.dtd">'


def test_elements_know_where_they_stand(made: Made) -> None:
    path = made.write(
        "a.xml", f'<?xml version="1.0"?>\n{DOCTYPE}\n<params>\n <param name="x"> 1\n 2 </param>\n</params>'
    )
    root = read_xml(path, Notes())
    (param,) = root.children
    assert (root.line, param.line, param.text, param.label) == (3, 4, "1\n 2", 'param "x"')


def test_a_prefix_that_nobody_declared_is_no_matter(made: Made) -> None:
    made.write("skin.xml", '<devices><device name="s" type="t"><xi:include href="spec.xml"/></device></devices>')
    made.write("spec.xml", '<params><param name="x">1</param></params>')
    reader = DeviceReader(Notes())
    (found,) = reader.devices(made.folder / "skin.xml")
    assert reader.group_of(found).params["x"].text == "1"


@pytest.mark.parametrize("include", ['<params file="hardware/spec.xml"/>', '<xi:include href="../hardware/spec.xml"/>'])
def test_files_are_found_from_the_file_and_from_the_robots_folder(made: Made, include: str) -> None:
    made.write("robot/skin/skin.xml", f'<device name="s" type="t">{include}</device>')
    made.write("robot/hardware/spec.xml", '<group name="g"><param name="x">1</param></group>')
    reader = DeviceReader(Notes())
    (found,) = reader.devices(made.folder / "robot/skin/skin.xml")
    assert reader.group_of(found).groups["g"].params["x"].text == "1"


@pytest.mark.parametrize("comment", ["<!-- a -- b -->", "<!-- a <!-- b -->", "<!-- a --->"])
def test_comments_end_at_the_first_end_as_robots_read_them(made: Made, comment: str) -> None:
    notes = Notes()
    root = read_xml(made.write("a.xml", f"<params>\n\n{comment}<param/>\n</params>"), notes)
    assert [child.tag for child in root.children] == ["param"]
    (note,) = notes.all()
    assert (note.level, note.line) == ("info", 3)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no element"),
        ("   ", "no element"),
        ("no xml", "syntax error"),
        ("<a><b></a>", "a.xml:1: not XML: mismatched tag"),
        ("<a>\n<b", "not XML: unclosed token"),
        ("<a/><b/>", "junk after document element"),
        ("<a x=1/>", "not well-formed"),
        (b"<a>\xff</a>", "not well-formed"),
        (b"\x00\x01", "not XML"),
        ('<?xml version="1.0" encoding="utf-7x"?><a/>', "not XML: unknown encoding"),
        ('<?xml version="1.0" encoding="utf-7"?><a/>', "not XML"),
        ("<a>" * 100 + "</a>" * 100, "nested deeper than 40"),
        ('<!DOCTYPE a [<!ENTITY b "x">]><a>&b;</a>', "defines the entity 'b'"),
        ('<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><a>&b;</a>', "defines the entity 'b'"),
        ('<!DOCTYPE a [<!ENTITY % b SYSTEM "http://x/y"> %b;]><a/>', "defines the entity 'b'"),
        ("<a>&b;</a>", "undefined entity"),
    ],
)
def test_what_is_no_xml_is_refused_with_its_place(made: Made, text: str | bytes, words: str) -> None:
    path = made.write("a.xml", text)
    with pytest.raises(ConfigurationError, match=words) as caught:
        read_xml(path, Notes())
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            '<!DOCTYPE l [<!ENTITY a0 "lol">'
            + "".join(f'<!ENTITY a{n} "{f"&a{n - 1};" * 10}">' for n in range(1, 12))
            + "]><l>&a11;</l>",
            "defines the entity 'a0'",
        ),
        (f'<!DOCTYPE l [<!ENTITY a "{"x" * 100_000}">]><l>{"&a;" * 100_000}</l>', "defines the entity 'a'"),
        ("<a>" + "<!--" * 500_000 + "</a>", "not well-formed"),
        ("<a>" + "<b>" * 500_000, "nested deeper"),
    ],
    ids=["billion laughs", "quadratic", "open comments", "depth"],
)
def test_bombs_are_refused_at_once(made: Made, text: str, words: str) -> None:
    path = made.write("a.xml", text)
    with pytest.raises(ConfigurationError, match=words):
        read_xml(path, Notes())


@pytest.mark.thorough
def test_many_comments_and_attributes_are_read(made: Made) -> None:
    attributes = " ".join(f'a{n}="1"' for n in range(100_000))
    root = read_xml(made.write("a.xml", f"<a {attributes}>{'<!---->' * 300_000}<b/></a>"), Notes())
    assert (len(root.attributes), len(root.children)) == (100_000, 1)


def test_an_undefined_entity_of_a_foreign_dtd_is_named(made: Made) -> None:
    notes = Notes()
    read_xml(made.write("a.xml", f"{DOCTYPE}<params>a&what;b</params>"), notes)
    assert [(note.level, note.element) for note in notes.all()] == [("unknown", "&what;")]


def test_what_is_no_file_is_refused(made: Made, tmp_path: Path) -> None:
    large = made.write("large.xml", b"<a>" + b" " * LARGEST_FILE + b"</a>")
    for path, words in ((tmp_path / "none.xml", "not there"), (tmp_path, "not there"), (large, "larger than 4 MiB")):
        with pytest.raises(ConfigurationError, match=words):
            read_xml(path, Notes())


@pytest.mark.parametrize("target", ["skin.xml", "", "http://x/y.xml", "a\nb", "x" * 5000, "/dev/zero", "."])
def test_includes_that_lead_nowhere_are_named(made: Made, target: str) -> None:
    made.write("skin.xml", device(f'<xi:include href="{target}"/>'))
    made.imported()
    assert "xi:include" in made.said("missing") + made.said("odd")


def test_files_that_include_each_other_come_to_an_end(made: Made) -> None:
    made.write("skin.xml", device('<xi:include href="s0.xml"/>'))
    for n in range(30):
        made.write(f"s{n}.xml", f'<params><xi:include href="s{(n + 1) % 30}.xml"/></params>')
    made.imported()
    assert "8 deep" in made.said("odd")
    made.write("s0.xml", "<params>" + '<xi:include href="s1.xml"/>' * 40 + "</params>")
    made.write("s1.xml", "<params>" + '<xi:include href="s2.xml"/>' * 40 + "</params>")
    with pytest.raises(ConfigurationError, match="more than 200 files included"):
        made.imported()
