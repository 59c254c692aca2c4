"""Every file and message that crosses a border: its schema and its reader."""
