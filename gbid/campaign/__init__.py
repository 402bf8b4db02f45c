"""Many fits: plan, engines, resume, collect."""
