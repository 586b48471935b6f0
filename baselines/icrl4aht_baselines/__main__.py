from icrl4aht_baselines.commands.cli import main

main()
