"""Names and paths as users give them: free text that is checked, shown safely, and cut for file names."""
