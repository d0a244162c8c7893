"""`ibrobot ui`: a page without a running robot, made of views.

A view is a module here with the functions that answer its requests, `ROUTES`, and a module of the same name in
`static/ui`, which shows it. `server.GROUPS` lists them in the order of the page.
"""
