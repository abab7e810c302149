"""Imports of recordings that were made elsewhere, to logs."""
