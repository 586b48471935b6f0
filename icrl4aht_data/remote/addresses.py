"""Addresses of remote releases: their credentials, which are never written or shown, and where a redirect may lead."""

from __future__ import annotations

import ipaddress
import os
import re
import socket
from fnmatch import fnmatchcase
from urllib.parse import SplitResult, urlsplit

from icrl4aht_data.errors import OptionError, RemoteError

REDIRECT_VARIABLE = "ICRL4AHT_REDIRECT_HOSTS"
"""Environment variable with hosts that other hosts may redirect to: names or patterns such as *.example.org, separated
by commas."""

_ADDRESS = re.compile(r"(?P<scheme>[A-Za-z][A-Za-z0-9+.-]*://)(?:[^/\s'\"<>]*@)?(?P<rest>[^\s?#'\"<>]*)[^\s'\"<>]*")
_AUTHORITY = re.compile(r"(?:https?|s3)://(?P<authority>[^/?#]*)(?P<path>[^?#]*)", re.IGNORECASE)
_HOST_AND_PORT = re.compile(r"(?:localhost|[\w-]+(?:\.[\w-]+)+|\[[0-9A-Fa-f:.]+\]):\d+")
_DEFAULT_PORTS = {"http": 80, "https": 443}


def without_credentials(text: str) -> str:
    """A text in which addresses are without user names, passwords, and what follows a "?" or "#", such as tokens."""
    return _ADDRESS.sub(r"\g<scheme>\g<rest>", text)


def check_credentials(address: str) -> None:
    """Check that the user name and password of an address end where its host begins.

    Where a password has characters such as "/", a part of it would be taken for the host or the path, which are shown.

    Raises:
        OptionError: if they may not; the message does not have the address.
    """
    for match in _AUTHORITY.finditer(address):
        authority, path = match["authority"], match["path"]
        port = re.fullmatch(r"(?:\[.*\]|[^:]*)(?::(\d*))?", authority.rpartition("@")[2])
        is_valid = port is not None and int(port[1] or 0) < 2**16 and not re.search(r"[\s'\"<>]", authority)
        path_has_user = ":" in authority and "@" in path and not _HOST_AND_PORT.fullmatch(authority)
        if path_has_user or not is_valid:
            raise OptionError(
                "an address, not shown because it may have a password: expected SCHEME://HOST:PORT/PATH or "
                "SCHEME://USER:PASSWORD@HOST/PATH: percent-encode the user name and password, such as / as %2F, and "
                "an @ in the path as %40"
            )


def address_of(folder: str, name: str) -> str:
    """Address of a file below an address, whose query, such as a token, belongs to every file."""
    path, mark, query = folder.partition("?")
    return f"{path.rstrip('/')}/{name}{mark}{query}"


def check_redirect(source: str, target: str, trusted: bool = False) -> None:
    """Check that a redirect may be followed; looks up the addresses of another host.

    A redirect may lead to the same host and port, from http to https too, and to hosts in `REDIRECT_VARIABLE`. From
    https it must lead to https, and from another machine it must not lead to this one or its local network.

    Args:
        source: address that was requested.
        target: address that the server names.
        trusted: whether the server may name any other host.

    Raises:
        RemoteError: names both addresses, without their credentials, and how to allow the redirect.
    """
    here, there = urlsplit(source), urlsplit(target)
    said = f"{without_credentials(source)}: redirects to {without_credentials(target)[:300]}"
    if there.scheme not in _DEFAULT_PORTS or not there.hostname:
        raise RemoteError(f"{said}: refused: expected http:// or https://")
    if here.scheme == "https" != there.scheme:
        raise RemoteError(f"{said}: refused: from https, only https is safe; ask its publisher to correct the server")
    if _host_and_port(here) == _host_and_port(there):
        return
    if here.hostname == there.hostname and (here.scheme, there.scheme) == ("http", "https") and there.port is None:
        return
    if not _is_local(here) and _is_local(there):
        raise RemoteError(f"{said}: refused: that is an address of this machine or of its local network")
    if not trusted and not any(fnmatchcase(there.hostname, pattern) for pattern in _allowed_hosts()):
        raise RemoteError(
            f"{said}: refused: another host than the one asked; if you trust it, set "
            f"{REDIRECT_VARIABLE}={there.hostname} (several hosts: separated by commas)"
        )


def _allowed_hosts() -> list[str]:
    return [host.strip().lower() for host in os.environ.get(REDIRECT_VARIABLE, "").split(",") if host.strip()]


def _host_and_port(address: SplitResult) -> tuple[str | None, int | None]:
    return address.hostname, address.port or _DEFAULT_PORTS.get(address.scheme)


def _is_local(address: SplitResult) -> bool:
    """Whether one of a host's IP addresses is loopback, link-local, or otherwise not of one other machine."""
    try:
        found = socket.getaddrinfo(address.hostname, None, type=socket.SOCK_STREAM)
    except OSError:  # no such host: connecting will say so
        return False
    for _, _, _, _, (text, *_) in found:
        ip = ipaddress.ip_address(str(text).partition("%")[0])
        ip = getattr(ip, "ipv4_mapped", None) or ip
        if ip.is_loopback or ip.is_link_local or ip.is_unspecified or ip.is_multicast:
            return True
    return False
