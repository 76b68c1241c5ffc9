"""From recorded data to provably stable models, proved funnels and live monitors."""
