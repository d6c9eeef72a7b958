"""From estimates and truth to figures."""
