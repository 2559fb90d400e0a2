"""Inputs by the thousand, in their order; what pairs frames before their names; frames beside one that is lost."""

import io
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import h5py
import numpy as np
import pytest

from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files import batch
from lfpiv_cli.files.atomic import write_json
from lfpiv_cli.files.batch import Frame, expanded, files_in, images_seen, results_seen
from lfpiv_cli.files.hdf5 import write_header
from lfpiv_cli.verbs import particles
from lfpiv_cli.verbs.pairs import PairOptions, found_pairs
from tests.commands import run


def test_numbers_in_names_count_by_their_value(tmp_path: Path) -> None:
    names = ["b10.tif", "a2.tif", "b9.tif", "B1.tif", "a2_1.tif", "a10.tif", "a02.tif"]
    for name in names:
        (tmp_path / name).touch()
    found = [path.name for path in files_in(tmp_path, "images")]
    assert found == ["a02.tif", "a2.tif", "a2_1.tif", "a10.tif", "B1.tif", "b9.tif", "b10.tif"]


def test_a_list_names_a_file_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = b"a b.tif\n\nodd\xff.tif\r\n/x/c.tif"
    (tmp_path / "list").write_bytes(content)
    (tmp_path / "a b.tif").touch()
    monkeypatch.chdir(tmp_path)
    expected = [Path("a b.tif"), Path("odd\udcff.tif"), Path("/x/c.tif")]
    assert batch.listed(tmp_path / "list") == expected
    monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=io.BytesIO(content)))
    assert batch.listed(Path("-")) == expected
    (tmp_path / "list").write_bytes(b"II*\0\0")
    (tmp_path / "rig.yaml").write_bytes(b"camera:\n  magnification: -1\n")
    no_lists = (
        (tmp_path / "list", "zero byte"),
        (tmp_path / "rig.yaml", "rig.yaml: is no list of files: of its 2 lines"),
    )
    for path, said in (*no_lists, (tmp_path / "none", "no such file"), (tmp_path, "a folder")):
        with pytest.raises(InputError, match=said):
            batch.listed(path)


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
            run("correlate", *arguments, *output)
    with pytest.raises(click.UsageError, match="no volumes were given"):
        run("correlate", *output)


AB = PairOptions(pairing="ab")


def result(folder: Path, name: str, image: str, page: int = 0, digest: str | None = None) -> Path:
    """Write a file that says of which page of which image it is made."""
    path = folder / f"{name}.vtkhdf"
    inputs = {"image": {"name": image, "sha256": digest or image}}
    with h5py.File(path, "w") as file:
        write_header(file, "lfpiv-volume", 1, {"command": f"reconstruct page {page}, mask: still", "inputs": inputs})
    return path


def test_pages_are_pairs_within_their_file_and_results_by_these(tmp_path: Path) -> None:
    frames = [
        Frame(Path(name), page, pages) for name, pages in (("x/r1.tif", 4), ("r2.tif", 3)) for page in range(pages)
    ]
    found = found_pairs(images_seen(frames), AB)
    assert found.pairs == ((0, 1), (2, 3), (4, 5))
    assert [each.about for each in found.left_out] == ["r2.tif, page 2"]
    # Page 1 is a second frame, whatever is left of the others.
    assert found_pairs(images_seen(frames[1:3]), AB).pairs == ()
    assert found_pairs(images_seen(frames[:3]), PairOptions(pairing="sequence")).pairs == ((0, 1), (1, 2))
    # Results of pages are pairs by these.
    left = [result(tmp_path, f"run_{page:04d}", "run.tif", page) for page in (0, 1, 2, 4, 5)]
    found = found_pairs(results_seen(left), AB)
    assert found.pairs == ((0, 1), (3, 4))
    assert [each.about for each in found.left_out] == [str(left[2])]
    # Each the first page of its file, as the second could not be read.
    first = [result(tmp_path, f"run{k}_0000", f"run{k}.tif") for k in (1, 2)]
    assert found_pairs(results_seen(first), AB).pairs == ()
    # Each a second one, whatever it is called.
    second = [result(tmp_path, name, f"run{k}.tif", 1) for k, name in enumerate(("early", "late"), start=1)]
    assert found_pairs(results_seen(second), AB).pairs == ()


def test_images_pair_results_whatever_their_names_but_once(tmp_path: Path) -> None:
    names = {"b": "img_1_a.tif", "a": "img_1_b.tif"}
    paths = [result(tmp_path, name, image) for name, image in names.items()]
    assert found_pairs(results_seen(paths), AB).pairs == ((0, 1),)
    assert found_pairs(results_seen(paths[::-1]), AB).pairs == ((1, 0),)
    # The same image twice is left out.
    paths = [result(tmp_path, f"{k}a", f"{k}a.tif", digest="same") for k in (1, 2)]
    paths += [result(tmp_path, f"{k}b", f"{k}b.tif") for k in (1, 2)]
    found = found_pairs(results_seen(paths), AB)
    assert found.pairs == ((0, 2),)
    assert [each.about for each in found.left_out] == [str(paths[1]), str(paths[3])]
    assert "same image" in found.left_out[0].text
    # Images of one name leave it to the results names.
    paths = [result(tmp_path, f"1{letter}", "image.tif", digest=letter) for letter in "ba"]
    broken = tmp_path / "2a.vtkhdf"
    broken.write_bytes(b"")
    write_json(tmp_path / "2b.vtkhdf", {}, overwrite=True)
    assert found_pairs(results_seen([*paths, broken, tmp_path / "2b.vtkhdf"]), AB).pairs == ((1, 0), (2, 3))


def test_two_without_options_are_taken_as_given(tmp_path: Path) -> None:
    given = [Path("1a.vtkhdf"), Path("1b.vtkhdf")]
    for path in given:
        (tmp_path / path).write_bytes(b"")
    paths = [tmp_path / path for path in given]
    assert found_pairs(results_seen(paths), PairOptions()).notices == ()
    backwards = found_pairs(results_seen(paths[::-1]), PairOptions())
    assert backwards.pairs == ((0, 1),)
    assert [notice.code for notice in backwards.notices] == ["pair-backwards"]
    apart = [tmp_path / "1a.vtkhdf", tmp_path / "2b.vtkhdf"]
    (tmp_path / "2b.vtkhdf").write_bytes(b"")
    (notice,) = found_pairs(results_seen(apart), PairOptions()).notices
    assert notice.code == "pair-contradicted"
    assert all(str(path) in str(notice) for path in apart)
    for count in (1, 3):
        with pytest.raises(UsageError, match=r"pairs"):
            found_pairs(results_seen([paths[0]] * count), PairOptions())


@pytest.fixture
def listed(tmp_path: Path):
    """Pairs by a list of this text, of the images x/1, x/2, x/3 and y/3, the last of two pages."""
    frames = [Frame(Path(f"x/{k}.tif"), 0, 1) for k in (1, 2, 3)] + [Frame(Path("y/3.tif"), k, 2) for k in (0, 1)]

    def of(text: str):
        (tmp_path / "pairs.csv").write_text(text)
        return found_pairs(images_seen(frames), PairOptions(pairs=tmp_path / "pairs.csv"))

    return of


def test_a_list_pairs_frames_by_any_name_that_is_one_frame_s(listed, tmp_path: Path) -> None:
    found = listed("# first second\nx/2.tif  1.tif\n\n3_0000, 3_0001 # late\n")
    assert found.pairs == ((1, 0), (3, 4))
    assert [notice.code for notice in found.notices] == ["frames-unlisted"]
    assert found.notices[0].measured == 1.0
    assert not found.left_out
    (tmp_path / "pairs.txt").write_text("3.tif x/3.tif\n")
    frames = [Frame(Path(f"{folder}/3.tif"), 0, 1) for folder in "xy"]
    with pytest.raises(InputError, match="name of 2 frames"):
        found_pairs(images_seen(frames), PairOptions(pairs=tmp_path / "pairs.txt"))
    with pytest.raises(UsageError, match="--pairs"):
        found_pairs(images_seen(frames), PairOptions(pairs=tmp_path / "pairs.txt", pair_by="{number}"))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1.tif 2.tif 3.tif", "csv:1: .* is not two names"),
        ("\n1.tif,", "csv:2: .* is not two names"),
        ("1.tif 1", "names 1.tif twice"),
        ("1.tif 4.tif", "4.tif: is in .*line 1, and not among"),
    ],
)
def test_a_list_that_cannot_be_followed_is_refused(listed, text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        listed(text).settled(keep_going=False)


BAD = 2


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Searches that return words for how they were made, of frames that are their own numbers."""
    stub = {
        "frame_of": lambda bench, raw, lit: int(raw),
        "find": lambda bench, frame, advance: f"{frame} alone",
        "find_first": lambda bench, frame, advance: f"{frame}",
        "find_second": lambda bench, frame, before, first, advance: f"{frame} after {first}",
        "find_beside": lambda bench, frame, own, others: f"{own} beside {' and '.join(others)}",
        "check_frame": lambda bench, raw, name: None,
    }
    for name, search in stub.items():
        monkeypatch.setattr(particles, name, search)


def finder(pairing: str, keep_going: bool, bad: int = BAD, images: int = 4) -> particles.Finder:
    def read(number: int) -> tuple[Any, Any]:
        if number == bad:
            raise InputError(f"f{number}.tif: is empty")
        return np.float32(number % images), np.float32(number % images)

    beside, first_of = [(1,), (0,), (3,), (2,)], {1: 0, 3: 2}
    if pairing == "sequence":
        beside, first_of = [(1,), (0, 2), (1, 3), (2,)], {}
    frames = [Frame(Path(f"f{number}.tif"), 0, 1) for number in range(4)]
    return particles.Finder(None, read, frames, beside, first_of, keep_going)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("pairing", "bad", "expected"),
    [
        ("ab", BAD, {0: "0 beside 1 after 0", 1: "1 after 0 beside 0", 3: "3 alone"}),
        ("sequence", BAD, {0: "0 beside 1", 1: "1 beside 0", 3: "3 alone"}),
        # In whatever order.
        ("ab", -1, {2: "2 beside 3 after 2", 3: "3 after 2 beside 2"}),
        ("ab", -1, {3: "3 after 2 beside 2", 2: "2 beside 3 after 2"}),
        ("sequence", -1, {1: "1 beside 0 and 2"}),
    ],
)
def test_those_beside_a_bad_frame_have_a_look_of_their_own(
    searched, pairing: str, bad: int, expected: dict[int, str]
) -> None:
    find = finder(pairing, True, bad).find
    for number, words in expected.items():
        found, notices = find(number, number, lambda steps: None)  # type: ignore[arg-type]
        lacking = bad == BAD and (number == 3 or (pairing == "sequence" and number == 1))
        assert found == words
        assert [(each.code, each.about) for each in notices] == [("frame-alone", f"f{number}")] * lacking
        assert all("without the help of f2: f2.tif: is empty" in notice.text for notice in notices)
    if bad == BAD:
        with pytest.raises(InputError, match=r"f2\.tif: is empty"):
            finder(pairing, False).find(3, 3, lambda steps: None)  # type: ignore[arg-type]


def test_a_frame_that_is_the_one_beside_it_again_is_said(searched) -> None:
    find = finder("sequence", False, -1, images=1).find
    reported = [find(number, number, lambda steps: None)[1] for number in range(4)]  # type: ignore[arg-type]
    assert [[(each.code, each.about) for each in notices] for notices in reported] == [
        *([("frames-alike", f"f{number}")] for number in range(3)),
        [],
    ]
    assert "the pixels of f1" in reported[0][0].text
