"""What every command shares: the result folder, its record, threads, memory and timing."""
