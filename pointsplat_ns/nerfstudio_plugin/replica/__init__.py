"""Captures in NICE-SLAM's Replica layout, which the synthetic rooms are written in, too."""
