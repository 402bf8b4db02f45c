"""Two-step LPV identification: surfaces over pressure and speed fitted to the estimates of many recordings."""
