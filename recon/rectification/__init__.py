"""From recorded pictures to rows that correspond, and from colour to grey."""
