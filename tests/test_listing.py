"""Inputs by the thousand: lists, folders, and their natural order."""

from __future__ import annotations

import io
from pathlib import Path
from types import SimpleNamespace

import click
import pytest

from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import InputError
from lfpiv_cli.files.listing import expanded, files_in, listed


def test_numbers_in_names_count_by_their_value(tmp_path: Path) -> None:
    names = ["b10.tif", "a2.tif", "b9.tif", "B1.tif", "a2_1.tif", "a10.tif", "a02.tif"]
    for name in names:
        (tmp_path / name).touch()
    found = [path.name for path in files_in(tmp_path, "images")]
    assert found == [
        "a02.tif",
        "a2.tif",
        "a2_1.tif",
        "a10.tif",
        "B1.tif",
        "b9.tif",
        "b10.tif",
    ]


def test_a_list_names_a_file_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = b"a b.tif\n\nodd\xff.tif\r\n/x/c.tif"
    (tmp_path / "list").write_bytes(content)
    (tmp_path / "a b.tif").touch()
    monkeypatch.chdir(tmp_path)
    expected = [Path("a b.tif"), Path("odd\udcff.tif"), Path("/x/c.tif")]
    assert listed(tmp_path / "list") == expected
    monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=io.BytesIO(content)))
    assert listed(Path("-")) == expected
    (tmp_path / "list").write_bytes(b"II*\0\0")
    (tmp_path / "rig.yaml").write_bytes(b"camera:\n  magnification: -1\n")
    no_lists = (
        (tmp_path / "list", "zero byte"),
        (tmp_path / "rig.yaml", "rig.yaml: is no list of files: of its 2 lines"),
    )
    for path, said in (*no_lists, (tmp_path / "none", "no such file"), (tmp_path, "a folder")):
        with pytest.raises(InputError, match=said):
            listed(path)


def test_a_folder_stands_for_its_files_of_a_kind(tmp_path: Path) -> None:
    folder = tmp_path / "many"
    (folder / "inner.tif").mkdir(parents=True)
    for name in ("10.TIF", "9.tif", ".hidden.tif", "v2.vtkhdf", "v10.vtkhdf", "notes.txt"):
        (folder / name).touch()
    (folder / "11.img").write_bytes(b"II*\0")
    images = [folder / name for name in ("9.tif", "10.TIF", "11.img")]
    assert expanded([tmp_path / "x.tif", folder], "images") == [tmp_path / "x.tif", *images]
    assert expanded([folder], "results") == [folder / "v2.vtkhdf", folder / "v10.vtkhdf"]
    (tmp_path / "empty").mkdir()
    for kind, said in (("images", "holds no images"), ("results", r"holds no \.vtkhdf files")):
        with pytest.raises(InputError, match=f"empty: {said}"):
            expanded([tmp_path / "empty"], kind)  # type: ignore[arg-type]


def test_commands_take_lists_and_folders(tmp_path: Path) -> None:
    (tmp_path / "vols").mkdir()
    for name in ("v1", "v2"):
        (tmp_path / "vols" / f"{name}.vtkhdf").touch()
    (tmp_path / "list").write_text(f"{tmp_path / 'vols'}\n")
    output = ["-o", str(tmp_path / "out.vtkhdf")]
    for arguments in (["--files-from", str(tmp_path / "list")], [str(tmp_path / "vols")]):
        with pytest.raises(InputError, match="v1.vtkhdf: is empty"):
            cli.main(["correlate", *arguments, *output], standalone_mode=False)
    with pytest.raises(click.UsageError, match="no volumes were given"):
        cli.main(["correlate", *output], standalone_mode=False)
