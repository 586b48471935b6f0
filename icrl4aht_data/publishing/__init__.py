"""Preparation of releases for publication, and upload to the Hugging Face Hub."""
