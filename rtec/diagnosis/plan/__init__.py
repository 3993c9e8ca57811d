"""Which tests separate which effects, before anything is measured."""
