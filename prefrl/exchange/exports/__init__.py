"""The forms in which answers leave a store: one file each family of forms."""
