// What tests/test_export_campaign.py asks of the stand-ins: R2S_STANDIN="key=number ...", a key that is absent is 0.
#pragma once
#include <cstdlib>
#include <sstream>
#include <string>

inline double asked(const std::string& key) {
  std::istringstream words(std::getenv("R2S_STANDIN") ? std::getenv("R2S_STANDIN") : "");
  for (std::string word; words >> word;)
    if (word.rfind(key + "=", 0) == 0) return std::stod(word.substr(key.size() + 1));
  return 0.0;
}
