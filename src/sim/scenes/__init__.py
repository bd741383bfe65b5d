"""Clean clips: photographs in motion, known targets, footage."""
