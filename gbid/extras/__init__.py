"""Packages of the optional extras, imported when they are needed."""

from gbid.extras.frames import data_frame
from gbid.extras.loading import extra_package
from gbid.extras.pictures import Pictured

__all__ = ["Pictured", "data_frame", "extra_package"]
