"""Packages of the optional extras, imported when they are needed."""

from gbid.extras.loading import extra_package

__all__ = ["extra_package"]
