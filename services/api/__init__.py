"""The HTTP interface. It writes jobs into the store and wakes workers up; it never imports the numeric core."""
