"""Proof with concealed physics: draw scenarios, fly them, show the diagnosis only the recordings, score its answers."""
