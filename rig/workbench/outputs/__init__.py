"""What a run leaves behind: the journal, words on the console, the report."""
