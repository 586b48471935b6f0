"""Notes on downloaded folders: where each came from, and which part of the release was requested.

They are kept in the data folder of this user, not in the release: a note in a release would come with it from
elsewhere, and could name any address to repair it from, or hide missing files.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from icrl4aht_data.errors import Icrl4ahtError
from icrl4aht_data.utils.files import atomic_write, json_hash, parse_json, read_text, write_json
from icrl4aht_data.utils.system import data_folder


@dataclass(frozen=True)
class DownloadNote:
    """Note of a download into a folder, kept outside it.

    Args:
        folder: the folder, resolved.
        url: address of the release, without credentials.
        release: hash of the manifest's content.
        files: names of all files requested so far.
    """

    folder: str
    url: str
    release: str
    files: list[str]

    def belongs_to(self, manifest: Mapping[str, str]) -> bool:
        """Whether the note is about the release of this manifest."""
        return self.release == json_hash(dict(manifest))


def read_note(folder: Path) -> DownloadNote | None:
    """The note on a folder; None if nothing was downloaded into it, or the note is damaged."""
    with suppress(OSError, Icrl4ahtError, TypeError):
        note = DownloadNote(**parse_json(read_text(_note_path(folder))))
        texts = [note.folder, note.url, note.release, *note.files]
        return note if note.folder == str(folder.resolve()) and all(isinstance(text, str) for text in texts) else None
    return None


def write_note(folder: Path, url: str, manifest: Mapping[str, str], files: Iterable[str]) -> None:
    """Note that files of a release are downloaded into a folder; adds to what was noted of the same release before.

    Without a data folder that can be written nothing is noted: the folder is then like one from elsewhere.
    """
    before, release = read_note(folder), json_hash(dict(manifest))
    requested = {*files, *(before.files if before is not None and before.release == release else ())}
    path, note = _note_path(folder), DownloadNote(str(folder.resolve()), url, release, sorted(requested))
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as partial:
            write_json(partial, asdict(note))


def _note_path(folder: Path) -> Path:
    key = hashlib.sha256(str(folder.resolve()).encode(errors="surrogateescape")).hexdigest()[:32]
    return data_folder() / "downloads" / f"{key}.json"
