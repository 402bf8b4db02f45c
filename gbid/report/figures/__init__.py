"""Figures: functions from a result to axes. Each file has data, drawing, and the names for `gbid figures`."""
