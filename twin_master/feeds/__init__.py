"""Messages of real assets: files, brokers and formats, in the order of the steps."""
