"""What turns the pages of docs/ into the site: blocks that run, names that link, the API."""
