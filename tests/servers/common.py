"""Servers on 127.0.0.1 that speak to the real clients: HTTP, S3, the Hugging Face Hub; and what they may do wrong."""

from __future__ import annotations

from tests.servers.faults import (
    Cut,
    Fault,
    Faults,
    Flip,
    Long,
    Redirect,
    Request,
    Rule,
    Short,
    Slow,
    Status,
)
from tests.servers.http import Server, http_server
from tests.servers.hub import Hub, hub_server
from tests.servers.process import forget_filesystems, uploads
from tests.servers.s3 import Bucket, s3_server

__all__ = [
    "Bucket",
    "Cut",
    "Fault",
    "Faults",
    "Flip",
    "Hub",
    "Long",
    "Redirect",
    "Request",
    "Rule",
    "Server",
    "Short",
    "Slow",
    "Status",
    "forget_filesystems",
    "http_server",
    "hub_server",
    "s3_server",
    "uploads",
]
