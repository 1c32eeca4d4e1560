"""What a run says of itself: terminal, metrics log, trackers, exporter, films; attaching to it."""
