"""The server of the pages: address, access, the application, and its start."""
