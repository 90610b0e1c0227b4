"""From brightness to events: sensor response and event loss."""
