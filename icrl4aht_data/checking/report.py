"""Report of the verification of a release."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from itertools import islice
from typing import Any, Literal

from icrl4aht_data.utils.text import counted_histories, counted_noun

Level = Literal["quick", "full", "deep"]
"""Depth of a verification, see `verify_release`."""

NamedProgress = Callable[[str, int, int], None]
"""Callback that receives the name of a stage, the number of items done, and their total."""

_FINDINGS = 100_000  # maximum number of findings in a report
_SHOWN = 5  # number of findings in the `repr` of a report
_LONG = 2000  # maximum number of characters of a finding


@dataclass(frozen=True)
class Finding:
    """One problem found in a release.

    Args:
        file: path of the file in the release's folder.
        problem: description of the problem.
    """

    file: str
    problem: str


@dataclass(repr=False)
class Report:
    """Result of `verify_release`.

    Args:
        root: folder or address of the release.
        level: depth of the verification.
        findings: problems, in the order in which they were found.
        notes: remarks that are not problems, such as checks that were impossible and shards that were not selected.
        replayed: whether every step was replayed under the rules.
        files: number of files checked.
        chunks: number of chunks decoded.
        histories: number of histories checked.
        transitions: number of steps of the checked histories.
    """

    root: str
    level: Level = "full"
    findings: list[Finding] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    replayed: bool = False
    files: int = 0
    chunks: int = 0
    histories: int = 0
    transitions: int = 0

    def __repr__(self) -> str:
        lines = [f"Report({self.root}, level {self.level}: {verdict_in_words(self)}"]
        lines += [f"    {finding.file}: {finding.problem:.200}" for finding in islice(self.findings, _SHOWN)]
        lines += ["    ..."] * (len(self.findings) > _SHOWN)
        return "\n".join(lines) + ")"

    @property
    def ok(self) -> bool:
        """Whether no problem was found."""
        return not self.findings

    @property
    def files_at_fault(self) -> set[str]:
        """Paths of the files in which problems were found."""
        return {finding.file for finding in self.findings}

    def to_json(self) -> dict[str, Any]:
        """Return the report as a JSON object: its fields, `ok`, and the booleans `deep` and `quick` for the level."""
        return {"ok": self.ok, **asdict(self), "deep": self.level == "deep", "quick": self.level == "quick"}

    def add(self, file: str, problem: str) -> None:
        """Add a finding; after 100,000 findings, add one that says that problems were omitted, and drop the rest."""
        if len(self.findings) < _FINDINGS:
            self.findings.append(Finding(_printable(file), _printable(problem)))
        elif len(self.findings) == _FINDINGS:
            self.findings.append(Finding(".", "more problems omitted: correct these first, then verify again"))


def _printable(text: str) -> str:
    """Shorten a text and escape its control characters, which a terminal would interpret."""
    text = text if len(text) <= _LONG else f"{text[:_LONG]}..."
    return text if text.isprintable() else text.encode("unicode_escape").decode()


def verdict_in_words(report: Report) -> str:
    """Return one line with the verdict and the numbers of files, chunks, histories and transitions checked."""
    verdict = "valid" if report.ok else counted_noun(len(report.findings), "problem")
    if report.level == "quick":
        return f"{verdict}; checked names, sizes and the index of {counted_noun(report.files, 'file')}, no contents"
    physics = " and their physics" if report.replayed else ""
    return (
        f"{verdict}; checked {counted_noun(report.files, 'file')}, {counted_noun(report.chunks, 'chunk')}, "
        f"{counted_histories(report.histories)}, {counted_noun(report.transitions, 'transition')}{physics}"
    )
