"""Preparing a release for publication and uploading it to the Hugging Face Hub."""
