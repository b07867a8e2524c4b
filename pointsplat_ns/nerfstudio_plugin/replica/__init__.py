"""Captures in the layout that NICE-SLAM gave to Replica, and the rooms that are written like them."""
