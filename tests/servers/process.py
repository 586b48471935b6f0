"""What clients in this process hold on to: the environment, fsspec's instances, huggingface_hub's constants."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import fsspec
import huggingface_hub
import pytest
from huggingface_hub import constants, hf_api, hf_file_system
from huggingface_hub.utils import _http

MISSING = object()

uploads = pytest.mark.filterwarnings("ignore:Use 'content=:DeprecationWarning")
"""For a test in whose process huggingface_hub 2.4 uploads by LFS: it calls httpx2 in a way that httpx2 warns of."""


@contextmanager
def environment(changes: Mapping[str, str | None]) -> Iterator[None]:
    """These variables for a while; None is unset."""
    before = {name: os.environ.get(name) for name in changes}
    try:
        _set(changes)
        yield
    finally:
        _set(before)


def _set(changes: Mapping[str, str | None]) -> None:
    for name, value in changes.items():
        os.environ.pop(name, None)
        if value is not None:
            os.environ[name] = value


def forget_filesystems(*protocols: str) -> None:
    """No filesystem of fsspec outlives the server that it talked to, nor the settings it was made from."""
    for protocol in protocols:
        fsspec.get_filesystem_class(protocol).clear_instance_cache()


def hub_environment(endpoint: str, home: Path, token: str) -> dict[str, str]:
    """What sends another process to this hub. Without HF_HUB_DISABLE_XET the client uploads by Xet or not at all."""
    return {
        "HF_ENDPOINT": endpoint,
        "HF_HOME": str(home),
        "HF_HUB_CACHE": str(home / "hub"),
        "HF_TOKEN": token,
        "HF_HUB_DISABLE_XET": "1",
        "HF_HUB_DISABLE_TELEMETRY": "1",
        "HF_HUB_DISABLE_UPDATE_CHECK": "1",
        "HF_UPDATE_DOWNLOAD_COUNTS": "0",  # `datasets` counts at another address
    }


NOT_FOR_A_TEST = ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE", "HUGGINGFACE_HUB_CACHE", "HF_TOKEN_PATH", "HF_XET_CACHE")
NOT_FOR_A_TEST += ("HF_OIDC_RESOURCE", "HF_HUB_DISABLE_IMPLICIT_TOKEN", "HUGGINGFACE_CO_STAGING", "HF_DATASETS_OFFLINE")


@contextmanager
def hub_settings(variables: Mapping[str, str]) -> Iterator[None]:
    """The environment of `hub_environment`, in a process that has imported huggingface_hub already.

    Its constants are replaced in every module that has copied them, and the endpoint of the two clients that it makes
    on import; its HTTP session and the cached filesystems are dropped on the way in and out.
    """
    changes, before = _changes(variables), constants.ENDPOINT
    with environment({**variables, **dict.fromkeys(NOT_FOR_A_TEST)}):
        try:
            _replace(changes)
            _restart(variables["HF_ENDPOINT"])
            yield
        finally:
            _replace({name: (new, old) for name, (old, new) in changes.items()})
            _restart(before)


def _changes(variables: Mapping[str, str]) -> dict[str, tuple[Any, Any]]:
    """Old and new values of constants, by name."""
    endpoint, home = variables["HF_ENDPOINT"], variables["HF_HOME"]
    values = {
        "ENDPOINT": endpoint,
        "HUGGINGFACE_CO_URL_TEMPLATE": endpoint + "/{repo_id}/resolve/{revision}/{filename}",
        "HF_URL_HOSTS": constants.HF_URL_HOSTS | {"127.0.0.1"},
        "HF_HOME": home,
        "HF_HUB_CACHE": variables["HF_HUB_CACHE"],
        "HUGGINGFACE_HUB_CACHE": variables["HF_HUB_CACHE"],
        "HF_ASSETS_CACHE": f"{home}/assets",
        "HF_XET_CACHE": f"{home}/xet",
        "HF_TOKEN_PATH": f"{home}/token",
        "HF_STORED_TOKENS_PATH": f"{home}/stored_tokens",
        "AGENT_HARNESSES_PATH": f"{home}/.agent_harnesses.json",
        "HF_HUB_DISABLE_XET": True,
        "HF_HUB_DISABLE_TELEMETRY": True,
        "HF_HUB_OFFLINE": False,
    }
    path, counts = "/datasets/{repo_id}/resolve/{revision}/{path}", "HF_UPDATE_DOWNLOAD_COUNTS"
    of_datasets = {
        "HF_ENDPOINT": (constants.ENDPOINT, endpoint),
        "HUB_DATASETS_URL": (constants.ENDPOINT + path, endpoint + path),
        counts: (getattr(sys.modules.get("datasets.config"), counts, True), False),
    }
    origins = _http._HUB_ORIGINS, _http._HUB_ORIGINS | {_http._url_origin(endpoint)}
    replaced = {name: (getattr(constants, name), value) for name, value in values.items()}
    return replaced | of_datasets | {"_HUB_ORIGINS": origins}


def _replace(changes: Mapping[str, tuple[Any, Any]]) -> None:
    for name, module in list(sys.modules.items()):
        if name.split(".")[0] in ("huggingface_hub", "datasets"):
            for constant, (old, new) in changes.items():
                if vars(module).get(constant, MISSING) == old:
                    vars(module)[constant] = new


def _restart(endpoint: str) -> None:
    hf_api.api.endpoint = endpoint
    hf_api.api._whoami_cache.clear()
    hf_file_system.hffs.endpoint = hf_file_system.hffs._api.endpoint = endpoint
    hf_file_system.hffs.invalidate_cache()
    huggingface_hub.close_session()
    forget_filesystems("hf")
