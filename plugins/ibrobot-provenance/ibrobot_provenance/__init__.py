"""Jobs and pools (`jobs`), the code that results depend on (`code`), and folders with one owner (`ownership`)."""
