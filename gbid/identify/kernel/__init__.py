"""Pass over the samples: blocks, recursion, and the compiled or numpy engine that runs it."""
