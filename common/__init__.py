"""Shared ground of all folders: seeding, settings as command-line options, durable files, provenance."""
