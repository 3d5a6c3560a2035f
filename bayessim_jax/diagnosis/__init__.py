"""Missing physics: is there a mismatch, where does it sit, which effect is it, and how sure can one be."""
