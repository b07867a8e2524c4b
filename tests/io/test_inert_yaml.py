"""Configurations are read as data: nothing in them is imported, called or expanded without bound."""

import sys
from pathlib import Path

import pytest

from pointsplat_ns.errors import SceneError
from pointsplat_ns.io.inert_yaml import Tagged, read_config


def read(tmp_path, text):
    (tmp_path / "config.yml").write_bytes(text if isinstance(text, bytes) else text.encode())
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


def nested(first, line, depth, *last):
    """A configuration in which each line holds the one before it, several times."""
    lines = [line.format(i=i, before=i - 1) for i in range(1, depth)]
    return "\n".join(["!!python/object:a.B", f"x0: &x0 {first}", *lines, *last])


@pytest.mark.parametrize(
    ("text", "fragment"),
    [
        # As a key a tuple is hashed, and a name is made to text: both would take the time and memory of all values.
        *(
            (
                nested("[a]", "x{i}: &x{i} " + kind + "[*x{before}, *x{before}]", 20, "? *x19", ": 1"),
                "more than 65536 values",
            )
            for kind in ("", "!!python/tuple ")
        ),
        ("!!python/object:a.B\nmethod_name: &x [*x]", "holds itself"),
        (nested("{k: v}", "x{i}: &x{i} {{<<: [*x{before}, *x{before}]}}", 4), "merge keys are not supported at line 3"),
        (b"\xff\xfe\xff", "not a nerfstudio config.yml"),
        ("a: [1, 2", "not a nerfstudio config.yml"),
        ("a: 1", "expected a saved trainer configuration"),
        ("", "expected a saved trainer configuration"),
        ("!!python/name:a.B ''", "expected a saved trainer configuration"),
        ("&a !!python/object:a.B {x: *a}", "recursive"),
        ("!!python/object:a.B {? [1, 2] : 3}", "unhashable"),
        ("!!python/object:a.B {x: " + "9" * 5000 + "}", "not a nerfstudio config.yml"),
        ("[" * 1500, "not a nerfstudio config.yml"),
        ("\x00", "not a nerfstudio config.yml"),
        ("a" * (1 << 20) + "a", "1048577 bytes"),
    ],
)
def test_what_is_no_configuration_is_said(tmp_path, text, fragment):
    fails(tmp_path, text, fragment)
