"""Servers on 127.0.0.1 that speak to the real clients: HTTP, S3, the Hugging Face Hub; and what they may do wrong."""

from __future__ import annotations

from servers_faults import (
    Cut,
    Etag,
    Fault,
    Faults,
    Flip,
    IgnoreRange,
    Long,
    Redirect,
    Request,
    Rule,
    Short,
    Slow,
    Status,
)
from servers_http import Server, http_server
from servers_hub import Hub, hub_server
from servers_process import forget_filesystems, uploads
from servers_s3 import Bucket, s3_server

__all__ = [
    "Bucket",
    "Cut",
    "Etag",
    "Fault",
    "Faults",
    "Flip",
    "Hub",
    "IgnoreRange",
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
