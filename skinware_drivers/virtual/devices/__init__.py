"""The devices that emulators ship for, one file each; each says only what is its own."""
