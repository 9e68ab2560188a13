"""Serves Gymnasium environments to Shoal through shared memory. The protocol is in Shoal's ``docs/PROTOCOL.md``."""

__version__ = "0.1.0"
