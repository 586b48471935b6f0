from icrl4aht_data.cli import main

main()
