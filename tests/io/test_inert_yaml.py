"""Configurations are read as data: nothing in them is imported, called or expanded without bound."""

import sys
from pathlib import Path

import pytest

from pointsplat_ns.errors import SceneError
from pointsplat_ns.io.inert_yaml import Tagged, read_config


def read(tmp_path, text):
    (tmp_path / "config.yml").write_text(text)
    return read_config(tmp_path / "config.yml")


def fails(tmp_path, text, *fragments):
    with pytest.raises(SceneError) as caught:
        read(tmp_path, text)
    message = str(caught.value)
    assert message.startswith(str(tmp_path / "config.yml")) and "\n" not in message
    for fragment in fragments:
        assert fragment in message, message


def test_python_tags_become_inert_values(tmp_path):
    root = read(
        tmp_path,
        """!!python/object:some.where.Config
_target: &id001 !!python/name:some.where.Class ''
again: *id001
path: !!python/object/apply:pathlib.PosixPath [/, data, scene]
newer: !!python/object/apply:pathlib._local.PosixPath [data]
windows: !!python/object/apply:pathlib.WindowsPath ['C:\\', data]
here: !!python/object/apply:pathlib.PosixPath []
size: !!python/tuple [1, 2.5, null]
enum: !!python/object/apply:some.where.Enum [value]
text: !!python/str '12'
number: !!python/long 12
inner: !!python/object:some.where.Inner {a: 1.0e-15}
other: !something {b: true}
""",
    )
    assert root.tag == "some.where.Config"
    assert root.fields == {
        "_target": Tagged("some.where.Class", None),
        "again": Tagged("some.where.Class", None),
        "path": Path("/data/scene"),
        "newer": Path("data"),
        "windows": Path("C:/data"),
        "here": Path("."),
        "size": (1, 2.5, None),
        "enum": Tagged("some.where.Enum", ["value"]),
        "text": "12",
        "number": 12,
        "inner": Tagged("some.where.Inner", {"a": 1e-15}),
        "other": Tagged("!something", {"b": True}),
    }


def test_a_hostile_file_runs_nothing(tmp_path):
    mark = tmp_path / "mark"
    root = read(
        tmp_path,
        f"""!!python/object:a.B
a: !!python/object/apply:os.system ['touch {mark}']
b: !!python/object/apply:subprocess.check_call [[touch, {mark}]]
c: !!python/object/new:subprocess.Popen [[touch, {mark}]]
d: !!python/object/apply:builtins.open ['{mark}', w]
e: !!python/module:antigravity ''
f: !!python/name:this.s ''
g: !!python/object/apply:pathlib.Path [[nested]]
""",
    )
    assert not mark.exists() and "antigravity" not in sys.modules and "this" not in sys.modules
    assert root.fields["a"] == Tagged("os.system", [f"touch {mark}"])
    assert all(isinstance(value, Tagged) for value in root.fields.values())


def test_nested_aliases_share_one_value(tmp_path):
    lines = ["!!python/object:a.B", "x0: &x0 [lol, lol, lol, lol]"]
    lines += [f"x{i}: &x{i} [{', '.join([f'*x{i - 1}'] * 4)}]" for i in range(1, 4)]
    deepest = read(tmp_path, "\n".join(lines)).fields["x3"]
    assert all(part is deepest[0] for part in deepest)


@pytest.mark.parametrize("kind", ["", "!!python/tuple "])
def test_aliases_that_stand_for_a_million_values_are_refused(tmp_path, kind):
    lines = ["!!python/object:a.B", f"x0: &x0 {kind}[lol, lol]"]
    lines += [f"x{i}: &x{i} {kind}[*x{i - 1}, *x{i - 1}]" for i in range(1, 20)]
    # As a key a tuple is hashed, and a name is made to text: both would take the time and memory of all values.
    fails(tmp_path, "\n".join([*lines, "? *x19", ": 1"]), "more than 65536 values")


def test_a_value_that_holds_itself_is_refused(tmp_path):
    fails(tmp_path, "!!python/object:a.B\nmethod_name: &x [*x]", "holds itself")


def test_nested_merge_keys_are_refused(tmp_path):
    lines = ["!!python/object:a.B", "x0: &x0 {k: v}"]
    lines += [f"x{i}: &x{i} {{<<: [{', '.join([f'*x{i - 1}'] * 9)}]}}" for i in range(1, 4)]
    fails(tmp_path, "\n".join(lines), "merge keys are not supported at line 3")


@pytest.mark.parametrize(
    ("text", "fragment"),
    [
        ("a: [1, 2", "not a nerfstudio config.yml"),
        ("a: 1", "expected a saved trainer configuration"),
        ("", "expected a saved trainer configuration"),
        ("!!python/name:a.B ''", "expected a saved trainer configuration"),
        ("&a !!python/object:a.B {x: *a}", "recursive"),
        ("!!python/object:a.B {? [1, 2] : 3}", "unhashable"),
        ("!!python/object:a.B {x: " + "9" * 5000 + "}", "not a nerfstudio config.yml"),
        ("[" * 5000, "not a nerfstudio config.yml"),
        ("\x00", "not a nerfstudio config.yml"),
        ("a" * (1 << 20) + "a", "1048577 bytes"),
    ],
)
def test_what_is_no_configuration_is_said(tmp_path, text, fragment):
    fails(tmp_path, text, fragment)


def test_bytes_that_are_no_text_are_said(tmp_path):
    (tmp_path / "config.yml").write_bytes(b"\xff\xfe\xff")
    with pytest.raises(SceneError, match="not a nerfstudio config.yml"):
        read_config(tmp_path / "config.yml")
