"""What the operating system gives: processes, locks, memory, and the log."""
