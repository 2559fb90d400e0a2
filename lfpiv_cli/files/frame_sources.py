"""What is known of frames besides their names: the pages of their files, and the images that results are of."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.batch import Frame
from lfpiv_cli.files.inputs import split_part
from lfpiv_cli.files.pairing import Seen
from lfpiv_cli.files.provenance import earlier_record

PAGE = re.compile(r"\bpage (\d+)\b")


def images_seen(frames: Sequence[Frame]) -> list[Seen]:
    """Return what is known of frames: their names and, of files of several, their pages."""
    return [
        Seen(
            name=str(frame.path) if frame.pages == 1 else f"{frame.path}, page {frame.page}",
            stem=split_part(frame.path)[0].stem,
            path=(frame.path.parent / frame.stem).as_posix(),
            page=None if frame.pages == 1 else frame.page,
            image=f"{frame.path} {frame.page}",
        )
        for frame in frames
    ]


def results_seen(paths: Sequence[Path]) -> list[Seen]:
    """Return what is known of volumes or particles: names and pages of the images that they are made from.

    Their own names count where these are not known, or are the same for different images.
    """
    sources = [_source(path) for path in paths]
    own = [Seen(str(path), path.stem, path.with_suffix("").as_posix()) for path in paths]
    pages: dict[str, set[int]] = defaultdict(set)
    for source in sources:
        if source is not None:
            pages[source.digest].add(source.page)
    seen = [
        each if source is None else _of_source(each, source, len(pages[source.digest]) > 1)
        for each, source in zip(own, sources, strict=True)
    ]
    if len({(each.stem, each.page) for each in seen}) == len({each.image or each.path for each in seen}):
        return seen
    return [replace(each, image=other.image) for each, other in zip(own, seen, strict=True)]


@dataclass(frozen=True)
class _Source:
    """The image of a result: its file's name without suffix and SHA-256, and the page."""

    stem: str
    digest: str
    page: int


def _source(path: Path) -> _Source | None:
    """Return the image that a result is made from; None where its record does not say, or the file is broken."""
    try:
        made = earlier_record(path) or {}
        image, page = made["inputs"]["image"], PAGE.search(made["command"])
        stem = split_part(Path(image["name"]))[0].stem
        return page and _Source(stem, image["sha256"], int(page[1]))
    except (InputError, KeyError, TypeError):
        return None  # what is broken is told where its turn comes


def _of_source(own: Seen, source: _Source, several: bool) -> Seen:
    """Return what is known of a result by its image: its page, too, where the image's file holds several."""
    several = several or source.page > 0 or own.stem == f"{source.stem}_{source.page:04d}"
    page = source.page if several else None
    return replace(own, stem=source.stem, page=page, image=f"{source.digest} {source.page}")
