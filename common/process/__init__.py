"""What every role's process needs: its loop, its watchdog, its parent's death, outages, memory."""
