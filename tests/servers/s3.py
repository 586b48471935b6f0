"""A simulated S3 bucket on 127.0.0.1."""

from __future__ import annotations

import logging
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import boto3
from moto.server import ThreadedMotoServer

from tests.servers.process import environment_variables


@contextmanager
def s3_server(folder: Path, bucket: str = "data") -> Iterator[str]:
    """Serve the files of a folder from an S3 bucket; yield the bucket's address, which fsspec opens without options."""
    logging.getLogger("werkzeug").setLevel(logging.ERROR)  # moto logs every request
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    endpoint = f"http://127.0.0.1:{server.get_host_and_port()[1]}"
    variables = {
        "AWS_ENDPOINT_URL": endpoint,
        "AWS_ENDPOINT_URL_S3": endpoint,
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_EC2_METADATA_DISABLED": "true",
    }
    try:
        # The user's AWS profile or session token would take precedence over the keys above.
        with environment_variables({**variables, "AWS_PROFILE": None, "AWS_SESSION_TOKEN": None}):
            client = boto3.Session().client("s3")
            client.create_bucket(Bucket=bucket)
            for path in sorted(folder.rglob("*")):
                if path.is_file():
                    key = path.relative_to(folder).as_posix()
                    client.put_object(Bucket=bucket, Key=key, Body=path.read_bytes())
            try:
                yield f"s3://{bucket}"
            finally:
                client.close()
    finally:
        # moto keeps buckets after its server has stopped, so they are deleted here.
        with urllib.request.urlopen(urllib.request.Request(f"{endpoint}/moto-api/reset", method="POST")):
            pass
        server.stop()
