from icrl4aht_data.commands.cli import main

main()
