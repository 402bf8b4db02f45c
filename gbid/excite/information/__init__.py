"""Information of a recording: line by line of its spectrum, and exactly by the sums of a fit."""
