"""The installed code that results depend on (`code`), and folders of results with one owner at a time (`ownership`)."""
