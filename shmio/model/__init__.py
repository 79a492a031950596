"""Types that local programs, clients and endpoints share."""
