"""What people do to bags: look inside, judge, cut, convert."""
