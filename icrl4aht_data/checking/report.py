"""TODO."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

_FINDINGS = 100_000


_LONG = 2000  # characters of a finding


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong."""

    file: str  # path below the root
    problem: str


@dataclass
class Report:
    """What `verify_release` looked at and found."""

    root: str
    deep: bool
    quick: bool = False
    findings: list[Finding] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)  # what was asked for but could not be checked, which is no fault
    repaired: list[str] = field(default_factory=list)
    replayed: bool = False
    files: int = 0
    chunks: int = 0
    histories: int = 0
    transitions: int = 0
    fetched_bytes: int = 0
    requests: int = 0

    @property
    def ok(self) -> bool:
        return not self.findings

    @property
    def files_at_fault(self) -> set[str]:
        """Of the release, in which something is wrong."""
        return {finding.file for finding in self.findings}

    def to_json(self) -> dict[str, Any]:
        return {"ok": self.ok, **asdict(self)}

    def add(self, file: str, problem: str) -> None:
        if len(self.findings) < _FINDINGS:
            self.findings.append(Finding(_plain(file), _plain(problem)))
        elif len(self.findings) == _FINDINGS:
            self.findings.append(Finding(".", "and more: mend these first, then verify again"))


def _plain(text: str) -> str:
    """Without what a terminal would obey, or cannot show."""
    text = text if len(text) <= _LONG else f"{text[:_LONG]}..."
    return text if text.isprintable() else text.encode("unicode_escape").decode()


NamedProgress = Callable[[str, int, int], None]
"""Called with what is being checked, how many are done, and how many there are."""
