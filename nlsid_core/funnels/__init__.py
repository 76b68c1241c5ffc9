"""Funnels: what a proof is about and a monitor holds a robot against."""
