"""Figures: a result in, axes out. Each file has its data, its drawing, and its names for `gbid figures`."""
