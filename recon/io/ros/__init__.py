"""Messages of ROS without ROS.

- `messages.py`: what we write, as mappings of fields, and their bytes (CDR);
- `contents.py`: what of others' messages we read, as values;
- `bag.py`: messages in a file (MCAP); `dds.py`: messages on a network, as ROS 2 sends them.
"""
