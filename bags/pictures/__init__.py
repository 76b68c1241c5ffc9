"""Pictures and reports (extra `report`: matplotlib)."""
