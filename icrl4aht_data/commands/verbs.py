"""Table of the commands of `icrl4aht-data`, which lets `--help` list all commands without importing them.

Another package adds commands by an entry point that names a table, in a module that is fast to import:

    [project.entry-points."icrl4aht_data.commands"]
    my_package = "my_package.verbs:VERBS"
"""

from __future__ import annotations

from typing import NamedTuple

VERB_GROUP = "icrl4aht_data.commands"
"""Entry-point group of tables of commands."""


class Verb(NamedTuple):
    """A command of the program, or a group of commands.

    Attributes:
        name: words that run the command, such as "list" or "release build".
        target: the click command, as "module:attribute"; empty for a group, whose commands start with its name.
        section: heading in the list of commands.
        help: one sentence.
    """

    name: str
    target: str
    section: str
    help: str


SECTIONS = ("Look", "Fetch and convert", "Train and evaluate", "Generate", "Publish", "Research")
"""Headings of the program's help, in order; headings of other packages follow."""

_CLI = "icrl4aht_data.commands.release_commands"

VERBS = (
    Verb("list", f"{_CLI}:list_", "Look", "List the tasks of a release."),
    Verb("show", f"{_CLI}:show", "Look", "Show a release, a part of it or one history."),
    Verb("browse", f"{_CLI}:browse", "Look", "Write an HTML page that shows and replays histories."),
    Verb("verify", f"{_CLI}:verify", "Look", "Verify a release: every byte, count and range."),
    Verb("doctor", f"{_CLI}:doctor", "Look", "Examine this installation, and report problems."),
    Verb("download", f"{_CLI}:download", "Fetch and convert", "Download a release, or a part of it."),
    Verb("convert", f"{_CLI}:convert", "Fetch and convert", "Convert a release or published files."),
    Verb("combine", f"{_CLI}:combine", "Fetch and convert", "Combine releases into one."),
    Verb("release", "", "Publish", "Prepare a release for publication."),
    Verb("release build", f"{_CLI}:build", "Publish", "Build a release for publication."),
    Verb("upload", f"{_CLI}:upload", "Publish", "Upload a release to the Hugging Face Hub, and tag it."),
    Verb("research", "", "Research", "Rebuild what the package bundles, and measure it."),
)
