"""Set environment variables, and huggingface_hub's constants in this process, for the duration of a test."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import huggingface_hub
import pytest
from huggingface_hub import constants, hf_api
from huggingface_hub.utils import _http

MISSING = object()

uploads = pytest.mark.filterwarnings("ignore:Use 'content=:DeprecationWarning")
"""Mark for tests that upload by LFS: huggingface_hub 2.4 passes httpx2 an argument that httpx2 warns about."""


@contextmanager
def environment_variables(changes: Mapping[str, str | None]) -> Iterator[None]:
    """Set environment variables within a context; the value None removes a variable."""
    with mock.patch.dict(os.environ):
        for name, value in changes.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
        yield


def hub_environment(endpoint: str, home: Path, token: str) -> dict[str, str]:
    """Return environment variables that direct a process to the test Hub and make it upload by LFS, not by Xet."""
    return {
        "HF_ENDPOINT": endpoint,
        "HF_HOME": str(home),
        "HF_HUB_CACHE": str(home / "hub"),
        "HF_TOKEN": token,
        "HF_HUB_DISABLE_XET": "1",
        "HF_HUB_DISABLE_TELEMETRY": "1",
        "HF_HUB_DISABLE_UPDATE_CHECK": "1",
    }


REMOVED = ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE", "HUGGINGFACE_HUB_CACHE", "HF_TOKEN_PATH", "HF_XET_CACHE")
REMOVED += ("HF_OIDC_RESOURCE", "HF_HUB_DISABLE_IMPLICIT_TOKEN", "HUGGINGFACE_CO_STAGING")


@contextmanager
def hub_settings(variables: Mapping[str, str]) -> Iterator[None]:
    """Direct this process, which has already imported huggingface_hub, to the test Hub within a context.

    The context replaces the client's constants in every module that has copied them, and the endpoint of the API object
    that the client makes on import. The client's HTTP session is closed at the start and at the end.

    Args:
        variables: environment variables from `hub_environment`.
    """
    changes, before = _changed_constants(variables), constants.ENDPOINT
    with environment_variables({**variables, **dict.fromkeys(REMOVED)}):
        try:
            _replace_constants(changes)
            _reset_client(variables["HF_ENDPOINT"])
            yield
        finally:
            _replace_constants({name: (new, old) for name, (old, new) in changes.items()})
            _reset_client(before)


def _changed_constants(variables: Mapping[str, str]) -> dict[str, tuple[Any, Any]]:
    """Return the constants of huggingface_hub that must change, as name -> (old value, new value)."""
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
    origins = _http._HUB_ORIGINS, _http._HUB_ORIGINS | {_http._url_origin(endpoint)}
    return {name: (getattr(constants, name), value) for name, value in values.items()} | {"_HUB_ORIGINS": origins}


def _replace_constants(changes: Mapping[str, tuple[Any, Any]]) -> None:
    for name, module in list(sys.modules.items()):
        if name.split(".")[0] == "huggingface_hub":
            for constant, (old, new) in changes.items():
                if vars(module).get(constant, MISSING) == old:
                    vars(module)[constant] = new


def _reset_client(endpoint: str) -> None:
    hf_api.api.endpoint = endpoint
    hf_api.api._whoami_cache.clear()
    huggingface_hub.close_session()
