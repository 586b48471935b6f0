"""Validation of a card's metadata with the answers of the Hub, for the fields that our cards have."""

from __future__ import annotations

import re
from typing import Any

import yaml

KNOWN_LICENSES = """
apache-2.0 mit openrail bigscience-openrail-m afl-3.0 artistic-2.0 bsl-1.0 bsd bsd-2-clause bsd-3-clause cc cc0-1.0
cc-by-2.0 cc-by-2.5 cc-by-3.0 cc-by-4.0 cc-by-sa-3.0 cc-by-sa-4.0 cc-by-nc-2.0 cc-by-nc-3.0 cc-by-nc-4.0 cc-by-nd-4.0
cc-by-nc-nd-3.0 cc-by-nc-nd-4.0 cc-by-nc-sa-2.0 cc-by-nc-sa-3.0 cc-by-nc-sa-4.0 cdla-sharing-1.0 cdla-permissive-1.0
cdla-permissive-2.0 wtfpl ecl-2.0 epl-1.0 epl-2.0 eupl-1.1 eupl-1.2 agpl-3.0 gfdl gpl gpl-2.0 gpl-3.0 lgpl lgpl-2.1
lgpl-3.0 isc mpl-2.0 ms-pl ncsa odc-by odbl openmdw-1.0 ofl-1.1 osl-3.0 pddl postgresql unlicense zlib etalab-2.0
unknown other
"""
KNOWN_SIZES = """
n<1K 1K<n<10K 10K<n<100K 100K<n<1M 1M<n<10M 10M<n<100M 100M<n<1B 1B<n<10B 10B<n<100B 100B<n<1T n>1T unknown
"""
TEXTS = ("pretty_name", "license_name", "license_link", "thumbnail", "library_name", "pipeline_tag")
LISTS = ("tags", "task_categories", "task_ids", "annotations_creators", "language_creators", "source_datasets")
LISTS += ("multilinguality", "size_categories", "datasets", "metrics")
TEXTS_OR_LISTS = ("license", "language", "base_model")


class _Loader(yaml.SafeLoader):
    """YAML loader that refuses a duplicate key, as the Hub does."""


def _mapping(loader: _Loader, node: yaml.MappingNode) -> dict:
    keys = [loader.construct_object(key, deep=True) for key, _ in node.value]
    if len(set(map(str, keys))) < len(keys):
        raise yaml.constructor.ConstructorError(problem="duplicated mapping key", problem_mark=node.start_mark)
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _mapping)


def metadata(content: str) -> dict[str, Any] | None:
    """The card's front matter, None without one.

    Raises:
        yaml.YAMLError: if it is not valid YAML or no mapping.
    """
    found = re.match(r"\ufeff?\s*---[ \t]*\r?\n(.*?)^---[ \t]*\r?$", content, re.DOTALL | re.MULTILINE)
    data = yaml.load(found[1], _Loader) if found else None
    if data is not None and not isinstance(data, dict):
        raise yaml.YAMLError("metadata must be an object")
    return data


def card_errors(content: str) -> tuple[list[str], list[str]]:
    """Errors and warnings that the Hub's validation returns for a card."""
    try:
        data = metadata(content)
    except yaml.YAMLError as error:
        return [f"YAML: {error}"], []
    if not data:
        return [], ["empty or missing yaml metadata in repo card"]
    errors = [f'"{name}" must be a string' for name in TEXTS if not isinstance(data.get(name, ""), str)]
    errors += [f'"{name}" must be an array' for name in LISTS if not isinstance(data.get(name, []), list)]
    for name in TEXTS_OR_LISTS:
        if not isinstance(data.get(name, ""), (str, list)):
            errors.append(f'"{name}" must be one of [string, array]')
    for name in (*LISTS, *TEXTS_OR_LISTS):
        for k, value in enumerate(values if isinstance(values := data.get(name), list) else []):
            if not isinstance(value, str):
                errors.append(f'"{name}[{k}]" must be a string')
    errors += _unknown("license", data.get("license"), KNOWN_LICENSES)
    errors += _unknown("size_categories", data.get("size_categories"), KNOWN_SIZES)
    if not isinstance(data.get("viewer", True), bool):
        errors.append('"viewer" must be a boolean')
    if not isinstance(data.get("dataset_info", {}), (dict, list)):
        errors.append('"dataset_info" must be one of [object, array]')
    if not isinstance(data.get("model-index", []), list):
        errors.append('"model-index" must be an array')
    return errors + _config_errors(data.get("configs", [])), []


def _unknown(name: str, found: Any, known: str) -> list[str]:
    return [
        f'"{name}" must be one of the known values, found "{value}"'
        for value in _listed(found)
        if isinstance(value, str) and value not in known.split()
    ]


def _config_errors(configs: Any) -> list[str]:
    if not isinstance(configs, list):
        return ['"configs" must be an array']
    errors, names = [], []
    for k, config in enumerate(configs):
        if not isinstance(config, dict) or not isinstance(config.get("config_name"), str):
            errors.append(f'"configs[{k}].config_name" is required')
            continue
        names.append(config["config_name"])
        for entry in _listed(config.get("data_files", [])):
            patterns = _listed(entry.get("path") if isinstance(entry, dict) else entry)
            if not all(isinstance(pattern, str) for pattern in patterns):
                errors.append(f'"configs[{k}].data_files" must be patterns, or objects with split and path')
    return errors + (['"configs" contains a config_name twice'] if len(set(names)) < len(names) else [])


def _listed(value: Any) -> list:
    return value if isinstance(value, list) else [value]
