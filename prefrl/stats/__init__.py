"""Statistics: intervals, and agreement between raters."""
