"""What pairs frames before their own names do: pages, the images that results are of, and lists."""

from __future__ import annotations

from pathlib import Path

import h5py
import pytest

from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files.atomic import write_json
from lfpiv_cli.files.batch import Frame
from lfpiv_cli.files.hdf5 import write_header
from lfpiv_cli.verbs.pairs import PairOptions, image_pairs, result_pairs

AB = PairOptions(pairing="ab")


def result(folder: Path, name: str, image: str, page: int = 0, digest: str | None = None) -> Path:
    """Write a file that says of which page of which image it is made."""
    path = folder / f"{name}.vtkhdf"
    inputs = {"image": {"name": image, "sha256": digest or image}}
    with h5py.File(path, "w") as file:
        write_header(file, "lfpiv-volume", 1, {"command": f"reconstruct page {page}, mask: still", "inputs": inputs})
    return path


def test_pages_are_pairs_within_their_file() -> None:
    frames = [
        Frame(Path(name), page, pages) for name, pages in (("x/r1.tif", 4), ("r2.tif", 3)) for page in range(pages)
    ]
    found = image_pairs(frames, AB)
    assert found.pairs == ((0, 1), (2, 3), (4, 5))
    assert [each.name for each in found.left_out] == ["r2.tif, page 2"]
    # Page 1 is a second frame, whatever is left of the others.
    assert image_pairs(frames[1:3], AB).pairs == ()
    assert image_pairs(frames[:3], PairOptions(pairing="sequence")).pairs == ((0, 1), (1, 2))


def test_the_image_of_a_result_pairs_it_whatever_its_name(tmp_path: Path) -> None:
    names = {"b": "img_1_a.tif", "a": "img_1_b.tif"}
    paths = [result(tmp_path, name, image) for name, image in names.items()]
    assert result_pairs(paths, AB).pairs == ((0, 1),)
    assert result_pairs(paths[::-1], AB).pairs == ((1, 0),)


def test_results_of_pages_are_pairs_by_these(tmp_path: Path) -> None:
    left = [result(tmp_path, f"run_{page:04d}", "run.tif", page) for page in (0, 1, 2, 4, 5)]
    found = result_pairs(left, AB)
    assert found.pairs == ((0, 1), (3, 4))
    assert [each.name for each in found.left_out] == [str(left[2])]
    # Each the first page of its file, as the second could not be read.
    first = [result(tmp_path, f"run{k}_0000", f"run{k}.tif") for k in (1, 2)]
    assert result_pairs(first, AB).pairs == ()
    # Each a second one, whatever it is called.
    second = [result(tmp_path, name, f"run{k}.tif", 1) for k, name in enumerate(("early", "late"), start=1)]
    assert result_pairs(second, AB).pairs == ()


def test_the_same_image_twice_is_left_out(tmp_path: Path) -> None:
    paths = [result(tmp_path, f"{k}a", f"{k}a.tif", digest="same") for k in (1, 2)]
    paths += [result(tmp_path, f"{k}b", f"{k}b.tif") for k in (1, 2)]
    found = result_pairs(paths, AB)
    assert found.pairs == ((0, 2),)
    assert [each.name for each in found.left_out] == [str(paths[1]), str(paths[3])]
    assert "same image" in found.left_out[0].why


def test_images_of_one_name_leave_it_to_the_results_names(tmp_path: Path) -> None:
    paths = [result(tmp_path, f"1{letter}", "image.tif", digest=letter) for letter in "ba"]
    broken = tmp_path / "2a.vtkhdf"
    broken.write_bytes(b"")
    write_json(tmp_path / "2b.vtkhdf", {}, overwrite=False)
    assert result_pairs([*paths, broken, tmp_path / "2b.vtkhdf"], AB).pairs == ((1, 0), (2, 3))


def test_two_without_options_are_taken_as_given(tmp_path: Path) -> None:
    given = [Path("1a.vtkhdf"), Path("1b.vtkhdf")]
    for path in given:
        (tmp_path / path).write_bytes(b"")
    paths = [tmp_path / path for path in given]
    assert result_pairs(paths, PairOptions()).notices == ()
    backwards = result_pairs(paths[::-1], PairOptions())
    assert backwards.pairs == ((0, 1),)
    assert [notice.code for notice in backwards.notices] == ["pair-backwards"]
    apart = [tmp_path / "1a.vtkhdf", tmp_path / "2b.vtkhdf"]
    (tmp_path / "2b.vtkhdf").write_bytes(b"")
    (notice,) = result_pairs(apart, PairOptions()).notices
    assert notice.code == "pair-contradicted"
    assert all(str(path) in str(notice) for path in apart)
    for count in (1, 3):
        with pytest.raises(UsageError, match=r"pairs"):
            result_pairs([paths[0]] * count, PairOptions())


@pytest.fixture
def listed(tmp_path: Path):
    """Pairs by a list of this text, of the images x/1, x/2, x/3 and y/3, the last of two pages."""
    frames = [Frame(Path(f"x/{k}.tif"), 0, 1) for k in (1, 2, 3)] + [Frame(Path("y/3.tif"), k, 2) for k in (0, 1)]

    def of(text: str):
        (tmp_path / "pairs.csv").write_text(text)
        return image_pairs(frames, PairOptions(pairs=tmp_path / "pairs.csv"))

    return of


def test_a_list_pairs_frames_by_any_of_their_names(listed) -> None:
    found = listed("# first second\nx/2.tif  1.tif\n\n3_0000, 3_0001 # late\n")
    assert found.pairs == ((1, 0), (3, 4))
    assert [notice.code for notice in found.notices] == ["frames-unlisted"]
    assert found.notices[0].measured == 1.0
    assert not found.left_out


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


def test_a_list_needs_names_that_are_one_frame_s(tmp_path: Path) -> None:
    (tmp_path / "pairs.txt").write_text("3.tif x/3.tif\n")
    frames = [Frame(Path(f"{folder}/3.tif"), 0, 1) for folder in "xy"]
    with pytest.raises(InputError, match="name of 2 frames"):
        image_pairs(frames, PairOptions(pairs=tmp_path / "pairs.txt"))
    with pytest.raises(UsageError, match="--pairs"):
        image_pairs(frames, PairOptions(pairs=tmp_path / "pairs.txt", pair_by="{number}"))
